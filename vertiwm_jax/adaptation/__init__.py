"""Adaptation while driving: soils are estimated, and a model's weights stay as they are."""
