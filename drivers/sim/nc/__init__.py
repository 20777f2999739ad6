"""The simulated NC: its part program, clock, macro variables and NC programs."""
