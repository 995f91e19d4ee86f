"""Any vehicle model as a navigation environment: tasks, observation, reward, endings, adapters."""
