"""Offline analysis of recordings and measurements; the resident daemon imports none of it."""
