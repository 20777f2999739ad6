"""The spindle of the simulated machine: beam, bearings, impact tests, milling."""
