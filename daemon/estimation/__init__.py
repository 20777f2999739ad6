"""Families of thermal models on line: with increments since the reference, and with lagged states."""
