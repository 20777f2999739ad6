"""The output: from estimate and CNC sample to the verified macro write."""
