"""The daemon beside a simulated machine or a recording, on real wires."""
