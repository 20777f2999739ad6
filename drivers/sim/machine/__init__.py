"""The physics of the simulated machine: heat, expansion, sensors, the hall around it."""
