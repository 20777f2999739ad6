"""The control law: states and limits of the output, baselines, the lifecycle of the reference, as pure functions."""
