"""Spindle."""
