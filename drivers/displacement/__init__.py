"""Displacement."""
