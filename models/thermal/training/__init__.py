"""Training and evaluation of thermal models; the resident daemon imports none of it."""
