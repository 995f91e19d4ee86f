"""Logged drives of other origin as recorded drives of this project: one file a kind of log."""
