"""Stability cases and recordings from files, and pictures of the results."""
