"""Warm up."""
