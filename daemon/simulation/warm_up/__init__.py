"""Milling on the simulated machine while it warms up, with and without tuning of the speed."""
