"""Compensation: from estimate and CNC sample to the verified macro write."""
