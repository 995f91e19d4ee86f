"""The vectorised environment does what Gymnasium says of options, or refuses them."""

import numpy as np
from env.worlds import bicycle_env, ground

from vertiwm_jax.env.gymnasium import NavigationVectorEnv
from vertiwm_jax.env.suites import circle_tasks


def test_only_those_that_are_asked_for_begin_anew():
    terrain = ground()
    env = NavigationVectorEnv(*bicycle_env(terrain, circle_tasks(terrain)), num_envs=3)
    env.reset(seed=0)
    actions = np.tile(np.array([1.0, 0.2], np.float32), (3, 1))
    for _ in range(5):
        driven, *_ = env.step(actions)
    mask = np.array([False, True, False])
    begun, _ = env.reset(options={"reset_mask": mask})
    np.testing.assert_array_equal(begun[~mask], driven[~mask])
    assert not np.array_equal(begun[mask], driven[mask])
