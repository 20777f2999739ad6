"""How what the NC applies reaches the tool point of the simulated machine: straight, or wrong on purpose."""

from collections.abc import Mapping
from dataclasses import dataclass, field

AXES = ("x", "y", "z")
"""Linear axes of the machine."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Wiring:
    """Movement of the tool point per micrometre applied."""

    um_per_um: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    """Applied axis -> moved axis -> um per um. An axis that is not named moves itself by what is applied."""

    def __post_init__(self) -> None:
        named = {*self.um_per_um, *(axis for moved in self.um_per_um.values() for axis in moved)}
        if unknown := sorted(named - set(AXES)):
            raise ValueError(f"the simulated machine has the axes {', '.join(AXES)}, not {', '.join(unknown)}")

    def moved_um(self, applied_um: Mapping[str, float]) -> dict[str, float]:
        """Return how far each axis of the tool point is moved [um] by what is applied per axis [um]."""
        moved = dict.fromkeys(AXES, 0.0)
        for applied_axis, um in applied_um.items():
            for axis, factor in self.um_per_um.get(applied_axis, {applied_axis: 1.0}).items():
                moved[axis] += factor * um
        return moved


STRAIGHT = Wiring()
"""As it should be."""
