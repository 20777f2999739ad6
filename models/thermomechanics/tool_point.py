"""The tool point's frequency response and its followed resonance, renewed once a cycle from temperatures.

Temperatures -> bearing properties (5-1) -> receptance through the condensed chain of spindle, holder and tool (4-35,
4-38) -> the resonance, followed by mode continuity (Figs 5-18, 5-19, 5-26).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from models.dynamics.assembly import CondensedAssembly, SpindleAssembly
from models.dynamics.beam import ComplexArray
from models.dynamics.bearings import groups_of, properties_from_parameters
from models.records import FloatArray, MachineTemperatures
from models.thermomechanics.history import SignalMeans, TemperatureHistory
from models.thermomechanics.regression import AxisRegression, EstimatedProperty, ThermomechanicalModel
from models.thermomechanics.resonance import Resonance, ResonanceFollower, band

SOURCE_BAND_HZ = (300.0, 2500.0)
SOURCE_STEP_HZ = 12800.0 / 16384.0
"""Band and spacing of the dissertation's analyser: 2817 frequencies."""
COARSE = 4
"""Steps between two states, and the ends of physical ranges, are looked at on every fourth frequency."""
ENDS_STAND_HZ = 0.5
"""They are looked at again when the resonance has moved by this [Hz], or other properties are flagged."""
WIDE_HZ = np.geomspace(20.0, 50_000.0, 5000)
"""Where resonances are looked for beside the band [Hz], with lines as close as the narrowest of steel are wide."""
LARGEST_BELOW_HZ = 10_000.0
"""The largest resonance is one below [Hz]: above, it stands on the damping of the file alone."""
FARTHEST_WIDTHS = 0.5
"""So far beside the fitted temperatures, in widths of their range, nothing is known of the bearings."""
REFERENCE_DEGC = 20.0
"""Where the resonance is chosen when the fit does not say which temperatures it saw."""


def source_frequencies() -> FloatArray:
    """Return 300 to 2500 Hz at the spacing of the dissertation's analyser [Hz], shape (2817,)."""
    low, high = SOURCE_BAND_HZ
    count = int((high - low) / SOURCE_STEP_HZ) + 1
    return np.asarray(low + SOURCE_STEP_HZ * np.arange(count), dtype=np.float64)


@dataclass(frozen=True, slots=True, kw_only=True)
class RangeEnds:
    """The resonance when one flagged property is taken to both ends of its physical range."""

    name: str
    at_lowest_hz: float | None
    """None: the mode is lost on the way there (it vanishes, or melts into another)."""
    at_highest_hz: float | None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AxisDynamics:
    """The tool point along one machine axis."""

    axis: str
    properties: tuple[EstimatedProperty, ...]
    receptance_m_per_n: ComplexArray
    """Displacement per force at the tool point [m/N], shape (n,)."""
    resonance: Resonance
    range_ends: tuple[RangeEnds, ...]
    """One for each flagged property."""

    @property
    def resonance_hz(self) -> float:
        """The followed resonance [Hz]."""
        return self.resonance.frequency_hz

    @property
    def flagged(self) -> tuple[str, ...]:
        """Names of the properties that stand at a physical bound."""
        return tuple(each.name for each in self.properties if each.flagged)

    @property
    def confidence(self) -> float:
        """0 to 1: the lowest of the properties'."""
        return min(each.confidence for each in self.properties)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ToolPointDynamics:
    """What is known about the dynamics of the tool point at one moment."""

    time_s: float
    """Monotonic time of the temperatures [s]."""
    frequency_hz: FloatArray
    """Shape (n,)."""
    axes: Mapping[str, AxisDynamics]
    signals: tuple[str, ...]
    degc: FloatArray
    """One-minute means of the signals [degC]."""
    inhibit: str
    """Why it should not be followed yet, '' when it can be."""
    model_id: str

    @property
    def resonance_hz(self) -> dict[str, float]:
        """The followed resonance per axis [Hz]."""
        return {axis: each.resonance_hz for axis, each in self.axes.items()}


class AxisTracker:
    """Properties, response and followed resonance of one axis from its temperatures."""

    def __init__(
        self,
        regression: AxisRegression,
        assembly: SpindleAssembly,
        frequency_hz: FloatArray,
        near_hz: float | None = None,
    ) -> None:
        """Condense the assembly and choose the resonance at the middle of the fitted temperatures.

        `regression`: from temperatures to bearing properties. `assembly`: spindle, holder and tool; its supports belong
        to the three groups of bearings. `frequency_hz`: evenly spaced [Hz], shape (n,). `near_hz`: the resonance
        nearest to this is followed [Hz]; None: the highest.
        """
        self.regression, self._assembly = regression, assembly
        self._condensed = CondensedAssembly(assembly, frequency_hz)
        self._coarse = CondensedAssembly(assembly, frequency_hz[::COARSE])
        start = self.parameters(self._reference())
        self._follower = ResonanceFollower(
            frequency_hz, self.receptance, start, near_hz, on_the_way=self._coarse_receptances
        )
        self._ends: tuple[float, tuple[RangeEnds, ...]] = (np.inf, ())

    def _reference(self, share: float = 0.5) -> tuple[EstimatedProperty, ...]:
        count, seen = len(self.regression.signals), self.regression.fitted_range
        degc = np.full(count, REFERENCE_DEGC)
        if seen is not None:
            degc = seen.lowest_degc + share * (seen.highest_degc - seen.lowest_degc)
        return self.regression.estimate(degc, dict.fromkeys(self.regression.intervals_min, np.zeros(count)))

    def beside_the_band(self) -> float | None:
        """Return the frequency of the largest resonance when the band does not hold it [Hz], None when it does.

        The real part of the receptance spans as much over a resonance as this one limits the depth of cut.
        """
        real = self.receptances_at(WIDE_HZ)[1].real
        low_hz, high_hz = self._condensed.frequency_hz[[0, -1]]
        below, above = low_hz > WIDE_HZ, (high_hz < WIDE_HZ) & (WIDE_HZ <= LARGEST_BELOW_HZ)
        within = (low_hz <= WIDE_HZ) & (high_hz >= WIDE_HZ)
        inside = np.ptp(real[within]) if within.any() else 0.0
        for beside in (below, above):
            if beside.any() and np.ptp(real[beside]) > inside:
                return float(WIDE_HZ[beside][np.argmin(real[beside])])
        return None

    def receptances_at(self, frequency_hz: FloatArray) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
        """Return the receptance at any frequencies [Hz], shape (n,), at lowest, middle and highest fitted temperatures.

        Result: three of the shape (n,) [m/N].
        """
        condensed = CondensedAssembly(self._assembly, frequency_hz)
        lowest, middle, highest = (
            condensed.receptance(properties_from_parameters(self.parameters(self._reference(share))))
            for share in (0.0, 0.5, 1.0)
        )
        return lowest, middle, highest

    def parameters(self, properties: Sequence[EstimatedProperty]) -> dict[str, float]:
        """Return all bearing parameters: those regressed, within their bounds, and those fixed."""
        return {**self.regression.fixed, **{each.name: each.value for each in properties}}

    def receptance(self, parameters: Mapping[str, float]) -> ComplexArray:
        """Return the receptance at the tool point [m/N], shape (n,)."""
        return self._condensed.receptance(properties_from_parameters(parameters))

    def _coarse_receptances(
        self, parameters: Mapping[str, FloatArray], low_hz: float, high_hz: float
    ) -> tuple[FloatArray, ComplexArray]:
        lines = band(self._coarse.frequency_hz, low_hz, high_hz)
        return self._coarse.frequency_hz[lines], self._coarse.receptances(parameters, lines)

    def renew(self, degc: FloatArray, differences_k: Mapping[float, FloatArray]) -> AxisDynamics:
        """Return the dynamics at new temperatures [degC] and changes [K], both of shape (m,); see `estimate`."""
        properties = self.regression.estimate(degc, differences_k)
        parameters = self.parameters(properties)
        response = self.receptance(parameters)
        resonance = self._follower.follow(parameters, response)
        flagged = [each for each in properties if each.flagged]
        return AxisDynamics(
            axis=self.regression.axis,
            properties=properties,
            receptance_m_per_n=response,
            resonance=resonance,
            range_ends=self._range_ends(flagged, parameters) if flagged else (),
        )

    def _range_ends(
        self, flagged: Sequence[EstimatedProperty], parameters: Mapping[str, float]
    ) -> tuple[RangeEnds, ...]:
        now = self._follower.resonance
        now_hz = now.frequency_hz
        if abs(self._ends[0] - now_hz) < ENDS_STAND_HZ and [e.name for e in self._ends[1]] == [e.name for e in flagged]:
            return self._ends[1]

        def end(name: str, value: float) -> float | None:
            """Return the resonance [Hz] with one property at an end of its range; None where no mode is followed."""
            if value == parameters[name]:
                return now_hz
            there = self._follower.reached(parameters, now, {**parameters, name: value}, roughly=True)
            return there.frequency_hz if there.continuous else None

        found = tuple(
            RangeEnds(
                name=each.name,
                at_lowest_hz=end(each.name, each.bounds.lowest),
                at_highest_hz=end(each.name, each.bounds.highest),
            )
            for each in flagged
        )
        self._ends = (now_hz if now.continuous else np.inf, found)
        return found


class ToolPointTracker:
    """Renews the tool point's dynamics with every cycle of the sensors."""

    def __init__(
        self,
        model: ThermomechanicalModel,
        assemblies: Mapping[str, SpindleAssembly],
        labels: Mapping[str, Sequence[int]],
        *,
        frequency_hz: FloatArray | None = None,
        near_hz: Mapping[str, float] | None = None,
    ) -> None:
        """Prepare everything that does not depend on temperatures.

        Raises ValueError when an axis has no regression, a signal no sensor, or an assembly other groups of bearings.

        `model`: regressions per axis; those of axes without an assembly are not used. `assemblies`: axis -> spindle,
        holder and tool along it. `labels`: label -> indices into the machine's sensor order, whose mean is the signal.
        `frequency_hz`: evenly spaced [Hz], shape (n,); None: those of the dissertation. `near_hz`: axis -> the
        resonance nearest to this is followed [Hz]; without: the highest.
        """
        if missing := sorted(set(assemblies) - set(model.axes)):
            raise ValueError(f"the model {model.model_id} holds no regression for axis {', '.join(missing)}")
        if missing := sorted(set(model.signals) - set(labels)):
            raise ValueError(
                f"no sensor carries the label {', '.join(missing)}, which the model {model.model_id} needs"
            )
        for axis, assembly in assemblies.items():
            regression, there = model.axes[axis], {support.group for support in assembly.shaft.supports}
            known = {*groups_of([*regression.fixed, *(each.name for each in regression.properties)])}
            if known != there:
                raise ValueError(
                    f"the model {model.model_id} knows the bearings {', '.join(sorted(known))} along {axis}, and the "
                    f"spindle has {', '.join(sorted(there)) or 'none'}"
                )
        self.model = model
        self.frequency_hz = source_frequencies() if frequency_hz is None else frequency_hz
        self._means = SignalMeans([labels[signal] for signal in model.signals])
        self._history = TemperatureHistory(model.intervals_min)
        self._last = np.full(len(model.signals), np.nan)
        self._columns = {
            axis: [model.signals.index(signal) for signal in model.axes[axis].signals] for axis in assemblies
        }
        self.axes = {
            axis: AxisTracker(model.axes[axis], assembly, self.frequency_hz, (near_hz or {}).get(axis))
            for axis, assembly in assemblies.items()
        }

    def renew(self, temperatures: MachineTemperatures) -> ToolPointDynamics | None:
        """Return the dynamics at new temperatures; None before every signal has had a value."""
        time = temperatures.trace.cleansed or temperatures.trace.last_byte
        return self.renew_from(time.monotonic_s, self._means.renew(temperatures.degc))

    def observe(self, time_s: float, degc: FloatArray) -> None:
        """Keep what the signals read [degC], NaN where unknown, shape (m,), at a time [s], and compute nothing."""
        self._history.add(time_s, degc)

    def renew_from(self, time_s: float, degc: FloatArray) -> ToolPointDynamics | None:
        """Return the dynamics when the signals read `degc` [degC], NaN where unknown, shape (m,); see `renew`."""
        self._history.add(time_s, degc)
        mean = self._history.mean_degc()
        if mean is None:
            return None
        reasons = []
        if unknown := [name for name, value in zip(self.model.signals, mean, strict=True) if not np.isfinite(value)]:
            reasons.append(f"no temperature of {', '.join(unknown)} for a minute; the last one stands")
        now = np.where(np.isfinite(mean), mean, self._last)
        if not np.isfinite(now).all():
            return None
        self._last = now
        differences, short = self._differences(now)
        if short:
            reasons.append(
                f"the changes of temperature need those of {' and '.join(f'{each:g}' for each in short)} min ago, "
                f"which are missing; the oldest are {self._history.covered_min:.1f} min old"
            )
        reasons += self._beside_the_fit(now)
        axes = {
            axis: tracker.renew(now[columns], {minutes: change[columns] for minutes, change in differences.items()})
            for (axis, tracker), columns in zip(self.axes.items(), self._columns.values(), strict=True)
        }
        reasons += [f"{axis}: the mode is lost" for axis, each in axes.items() if not each.resonance.continuous]
        return ToolPointDynamics(
            time_s=time_s,
            frequency_hz=self.frequency_hz,
            axes=axes,
            signals=self.model.signals,
            degc=now,
            inhibit="; ".join(reasons),
            model_id=self.model.model_id,
        )

    def _beside_the_fit(self, now: FloatArray) -> list[str]:
        """Return which axes' temperatures lie too far beside those of the fit, in words."""
        said = []
        for axis, tracker in self.axes.items():
            seen, degc = tracker.regression.fitted_range, now[self._columns[axis]]
            if seen is None or seen.departure(degc) <= FARTHEST_WIDTHS:
                continue
            rows = zip(tracker.regression.signals, degc, seen.lowest_degc, seen.highest_degc, strict=True)
            levels = ", ".join(f"{name} {at:.1f} degC (fitted {low:.1f} to {high:.1f})" for name, at, low, high in rows)
            said.append(
                f"{axis}: the bearings were fitted at other temperatures: {levels}; fit a campaign that has these"
            )
        return said

    def _differences(self, now: FloatArray) -> tuple[dict[float, FloatArray], list[float]]:
        """Return the changes over each interval [K] and the intervals [min] that are not covered (no change)."""
        found: dict[float, FloatArray] = {}
        short = []
        for minutes in self.model.intervals_min:
            then = self._history.mean_degc(minutes)
            if then is None or not np.isfinite(then).all():
                short.append(minutes)
                then = now if then is None else np.where(np.isfinite(then), then, now)
            found[minutes] = np.asarray(now - then, dtype=np.float64)
        return found, short
