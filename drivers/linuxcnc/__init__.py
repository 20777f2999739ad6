"""LinuxCNC on this computer, by a program that runs with LinuxCNC's own Python modules."""
