"""Spindle speed."""
