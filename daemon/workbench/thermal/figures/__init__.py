"""Draws the figures of the dissertation's chapter on thermal errors from the recordings of a campaign."""
