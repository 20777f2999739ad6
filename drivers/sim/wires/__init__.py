"""The wires of the simulated machine: serial lines, displacement file, OPC UA server."""
