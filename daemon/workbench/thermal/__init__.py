"""Thermal."""
