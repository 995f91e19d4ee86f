"""Learned pieces, nothing composed."""
