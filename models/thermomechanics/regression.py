"""Bearing properties from temperatures: multiple linear regression (5-1) with physical bounds.

A property is ``b . x`` with the explanatory variables of section 5.3.2: 1, the temperatures T, their changes
dT = T(t) - T(t - interval), and the squares of the changes; thirteen of them for four signals. The regression says
what it says; what it says beside the physical bounds is clamped there and flagged.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from models.dynamics.bearings import KINDS, groups_of, parameters_of
from models.model_file import ModelError, Numbers
from models.records import FloatArray

AXES = ("x", "y")


@dataclass(frozen=True, slots=True, kw_only=True)
class Bounds:
    """Physical range of one kind of property."""

    lowest: float
    highest: float

    def __post_init__(self) -> None:
        """Refuse bounds that are none; raises ModelError."""
        if not (np.isfinite([self.lowest, self.highest]).all() and 0.0 <= self.lowest < self.highest):
            raise ModelError("bounds", f"must be finite, not negative and ascend, not {self.lowest}, {self.highest}")


@dataclass(frozen=True, slots=True, kw_only=True)
class EstimatedProperty:
    """One bearing property as estimated from temperatures, in SI units."""

    name: str
    raw: float
    """As regressed."""
    value: float
    """Clamped at the physical bound."""
    flagged: bool
    """The regression left the physical range: `value` is a bound, not an estimate."""
    bounds: Bounds
    confidence: float
    """1 inside the ranges of the fit, falling to 0 one range width beside them; 0 when flagged.
    1 also where the ranges of the fit are not known."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PropertyRegression:
    """Regression of one bearing property on temperatures.

    Raises ModelError when name, shapes or numbers do not fit together.
    """

    name: str
    """One of the parameters of a group of bearings, such as kt_34."""
    interval_min: float
    """Interval of the difference terms [min]; 0: no such terms."""
    coefficients: Numbers
    """Of 1, T, dT and dT^2, shape (1 + 3 m,), or of 1 and T, shape (1 + m,), when the interval is 0."""
    bounds: Bounds
    deviation: float | None = None
    """Root mean square of what the fit leaves over, in the property's unit; None where it is not known."""

    def __post_init__(self) -> None:
        """Check what can be checked without the signals; raises ModelError."""
        kind, _, group = self.name.partition("_")
        if kind not in KINDS or not group:
            raise ModelError("properties", f"{self.name!r} is no bearing property: {', '.join(KINDS)}, _ and its group")
        if not (np.isfinite(self.interval_min) and self.interval_min >= 0.0):
            raise ModelError(f"properties.{self.name}.interval_min", "must be 0 or above")
        if self.coefficients.ndim != 1 or not np.isfinite(self.coefficients).all():
            raise ModelError(f"properties.{self.name}.coefficients", "must be a row of finite numbers")
        self.coefficients.flags.writeable = False


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FittedRange:
    """Temperatures that a fit has seen."""

    lowest_degc: Numbers
    """Of each signal [degC], shape (m,)."""
    highest_degc: Numbers

    def __post_init__(self) -> None:
        """Check shapes and order; raises ModelError."""
        if self.lowest_degc.shape != self.highest_degc.shape or not np.all(self.lowest_degc <= self.highest_degc):
            raise ModelError("fitted_range", "needs ascending pairs, one for each signal")

    def departure(self, degc: FloatArray) -> float:
        """Return how far temperatures [degC], shape (m,), lie outside, in widths of the range; 0 inside."""
        width = np.maximum(self.highest_degc - self.lowest_degc, SMALLEST_WIDTH_K)
        outside = np.maximum(self.lowest_degc - degc, degc - self.highest_degc)
        return float(np.max(np.maximum(outside, 0.0) / width, initial=0.0))


SMALLEST_WIDTH_K = 1.0
"""A signal that hardly moved during the fit counts as having moved by this [K]."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AxisRegression:
    """All regressions of one machine axis.

    Raises ModelError when shapes and names do not fit together.
    """

    axis: str
    signals: tuple[str, ...]
    """Labels of the temperature sensors, in the order of the coefficients."""
    properties: tuple[PropertyRegression, ...]
    fixed: Mapping[str, float]
    """The parameters that are not regressed, by name (section 5.2.3)."""
    fitted_range: FittedRange | None = None
    """None where it is not known."""

    def __post_init__(self) -> None:
        """Check that all parameters of every group are there once; raises ModelError."""
        names = [each.name for each in self.properties] + list(self.fixed)
        needed = parameters_of(sorted(groups_of(names)))
        if sorted(names) != sorted(needed):
            wrong = sorted(set(needed) ^ set(names)) or sorted({name for name in names if names.count(name) > 1})
            raise ModelError(
                f"axes.{self.axis}", f"each of {', '.join(needed)} must stand once, regressed or fixed: see {wrong}"
            )
        count = len(self.signals)
        if self.fitted_range is not None and self.fitted_range.lowest_degc.shape != (count,):
            raise ModelError(f"axes.{self.axis}.fitted_range", f"needs {count} ascending pairs, one for each signal")
        for each in self.properties:
            wanted = 1 + count * (3 if each.interval_min else 1)
            if each.coefficients.shape != (wanted,):
                raise ModelError(
                    f"axes.{self.axis}.{each.name}.coefficients",
                    f"{count} signals need {wanted} coefficients, there are {each.coefficients.size}",
                )

    @property
    def intervals_min(self) -> tuple[float, ...]:
        """Intervals of the difference terms that the estimate needs [min], ascending."""
        return tuple(sorted({each.interval_min for each in self.properties if each.interval_min}))

    def estimate(self, degc: FloatArray, differences_k: Mapping[float, FloatArray]) -> tuple[EstimatedProperty, ...]:
        """Return the regressed properties.

        Raises ValueError when a temperature or a change is not finite, or the shapes differ.

        `degc`: temperatures of the signals now [degC], shape (m,). `differences_k`: interval [min] -> change of the
        signals over it [K], shape (m,); every one of `intervals_min`.
        """
        given = {0.0: np.zeros(0), **differences_k}
        for what, values in (("temperature", degc), *((f"change over {k:g} min", differences_k[k])
                             for k in self.intervals_min)):  # fmt: skip
            if values.shape != (len(self.signals),):
                raise ValueError(f"{what}: {len(self.signals)} values are needed ({', '.join(self.signals)})")
            if not np.isfinite(values).all():
                missing = self.signals[int(np.argmin(np.isfinite(values)))]
                raise ValueError(f"{what} of {missing} is not known")
        inside = 1.0 if self.fitted_range is None else max(0.0, 1.0 - self.fitted_range.departure(degc))
        return tuple(
            _estimated(each, explanatory_variables(degc, given[each.interval_min]), inside) for each in self.properties
        )


def _estimated(regression: PropertyRegression, variables: FloatArray, inside: float) -> EstimatedProperty:
    raw = float(regression.coefficients @ variables)
    bounds = regression.bounds
    value = min(max(raw, bounds.lowest), bounds.highest)
    flagged = value != raw
    return EstimatedProperty(
        name=regression.name,
        raw=raw,
        value=value,
        flagged=flagged,
        bounds=bounds,
        confidence=0.0 if flagged else inside,
    )


def explanatory_variables(degc: FloatArray, difference_k: FloatArray) -> FloatArray:
    """Return 1, T, dT and dT^2 of section 5.3.2.

    Result: shape (..., 1 + 3 m), or (..., 1 + m).

    `degc`: temperatures [degC], shape (..., m). `difference_k`: their changes over the interval [K], shape (..., m); of
    shape (..., 0): 1 and T alone.
    """
    one = np.ones((*degc.shape[:-1], 1))
    return np.concatenate([one, degc, difference_k, difference_k**2], axis=-1)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ThermomechanicalModel:
    """Bearing properties from temperatures, for one or both machine axes."""

    model_id: str
    source: str
    """Where the coefficients come from, in a sentence."""
    created: str
    """Date and time (ISO 8601), or the date of publication."""
    rigid_rotary_inertia: str
    """Setting of the beam model with which the bearings were identified: correct or published."""
    spindle_sha256: str
    """Checksum of the spindle file with which they were identified; empty where there was none."""
    axes: Mapping[str, AxisRegression]
    training: tuple[str, ...] = ()
    """What was measured for it, one sentence each."""
    shaft_sha256: str = ""
    """Checksum of the shaft with which they were identified, whatever is clamped into it; empty where nobody says."""

    def __post_init__(self) -> None:
        """Check axes and setting; raises ModelError."""
        if not self.axes or not set(self.axes) <= set(AXES):
            raise ModelError("axes", f"must be some of {', '.join(AXES)}, not {', '.join(self.axes) or 'none'}")
        if wrong := [name for name, each in self.axes.items() if each.axis != name]:
            raise ModelError(f"axes.{wrong[0]}", "holds the regressions of another axis")
        if self.rigid_rotary_inertia not in ("correct", "published"):
            raise ModelError("rigid_rotary_inertia", "must be correct or published")

    @property
    def signals(self) -> tuple[str, ...]:
        """Labels of all temperature sensors that any axis needs."""
        return tuple(dict.fromkeys(signal for axis in self.axes.values() for signal in axis.signals))

    @property
    def intervals_min(self) -> tuple[float, ...]:
        """Intervals of all difference terms [min], ascending."""
        return tuple(sorted({interval for axis in self.axes.values() for interval in axis.intervals_min}))
