"""The edge daemon, and beside it the commands, the offline workbench and the simulation."""
