"""The daemon as an OPC UA server: its tags, its users, its place on the network."""
