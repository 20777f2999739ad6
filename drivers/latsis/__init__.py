"""Latsis."""
