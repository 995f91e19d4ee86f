"""Learned models of a vehicle: the specialists of Verti-WM, their fusion, and what they see."""
