"""The fault campaign: machine and daemon in virtual time, under scripted and random faults."""
