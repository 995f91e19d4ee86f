"""Tests of models and policies: prediction errors, navigation results, plots."""
