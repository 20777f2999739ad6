"""The daemon beside a simulated machine or a recording, on real wires."""

from models.errors import RefusedInputError


class SimulationError(RefusedInputError):
    """The simulated machine could not be built or set up, or its run broke off; the text says why."""
