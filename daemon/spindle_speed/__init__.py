"""Tuning of the spindle speed in the daemon: operation, plan, decision, block."""
