"""Commissioning: each axis is moved while a person reads an instrument, and the record of it is written."""
