"""Commissioning: a person sees each axis move the right way, and the record of it."""
