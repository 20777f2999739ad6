"""Everything that touches a wire or a file of somebody else."""
