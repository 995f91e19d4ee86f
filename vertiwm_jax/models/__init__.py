"""Models by name, and fitted models on disk."""
