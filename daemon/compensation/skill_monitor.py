"""Compares the estimate with displacements and probe values while the daemon runs, and inhibits one that does harm."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from config.schema import Configuration
from models.control.axis_map import AxisSource, nose_errors_um
from models.control.state import Inhibit, InhibitCode, OutputInputs, OutputMemory
from models.records import CncSample, DisplacementSample, FloatArray, ProbeSample, ThermalErrorEstimate

if TYPE_CHECKING:
    from daemon.compensation.sloped_skill import SlopedSkill


LEAST_PAIRS = 10
"""Fewer measurements prove nothing."""
MARGIN = 1.25
"""The estimate does harm when it leaves so many times the error that there would be without it."""
MOST_PAIRS = 60
"""So many latest measurements count."""
ONE_TIME_S, CYCLES = 180.0, 2.0
"""A row belongs to the estimate so many seconds, or cycles of the temperatures, before and after it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SkillRecord:
    """The latest measurements of one axis since a reference."""

    measured_um: tuple[float, ...] = ()
    """Error without compensation [um]."""
    left_um: tuple[float, ...] = ()
    """The same minus the estimate [um]."""


def with_measurement(record: SkillRecord, measured_um: float, estimated_um: float) -> SkillRecord:
    """Return the record with measured minus applied, and the estimate of then [um]; unchanged by what is not finite."""
    if not (np.isfinite(measured_um) and np.isfinite(estimated_um)):
        return record
    keep = 1 - MOST_PAIRS
    return replace(
        record,
        measured_um=(*record.measured_um[keep:], measured_um),
        left_um=(*record.left_um[keep:], measured_um - estimated_um),
    )


def rms_um(values_um: tuple[float, ...]) -> float:
    """Return the root mean square [um]; 0 without values."""
    return float(np.sqrt(np.mean(np.square(values_um)))) if values_um else 0.0


def does_harm(record: SkillRecord, least_error_um: float) -> bool:
    """Return whether the estimate leaves more than `MARGIN` times what there would be without it.

    It takes `LEAST_PAIRS` measurements for a verdict; below `least_error_um` neither says anything.
    """
    if len(record.left_um) < LEAST_PAIRS:
        return False
    left = rms_um(record.left_um)
    return left > max(MARGIN * rms_um(record.measured_um), least_error_um)


class SkillWatch:
    """Compares measured with estimated errors since the reference; owned by the control task.

    A displacement channel belongs to the axis whose estimate has its name. It is taken to feel what the
    NC applies, so measured minus applied is the error without compensation. On an axis with a slope estimate and
    compensation are those where the axis stood. `say`: tells a person what is not judged.
    """

    def __init__(
        self, sources: Sequence[AxisSource], configuration: Configuration, say: Callable[[str], None] = lambda _: None
    ) -> None:
        displacements = configuration.displacements
        channels = [] if displacements is None else [(each.axis, each.name) for each in displacements.every_channel]
        self._sources = tuple(sources)
        self._axes = tuple(source.axis for source in sources)
        places = {name: place for place, (axis, name) in enumerate(channels) if axis is None}
        places |= {axis: place for place, (axis, _) in enumerate(channels) if axis is not None}
        of_axis = {s.axis: places.get(s.axis, places.get(s.channel)) for s in sources if s.channel}
        self._column = {axis: place for axis, place in of_axis.items() if place is not None}
        self._least_error_um = configuration.compensation.output.harm_above_um
        self._say, self._told = say, False
        self._one_time_s = max(ONE_TIME_S, CYCLES * configuration.temperatures.shortest_period_s)
        self._counted: tuple[str | None, str | None] = (None, None)
        self._records: dict[str, SkillRecord] = {}
        self._inhibit: Inhibit | None = None
        self._judged = True
        """Whether that is the verdict on the latest measurement."""
        self._zero: dict[tuple[str, int], tuple[float, float, float]] = {}
        """By axis and place: measured, estimated and applied where it counts from [um]."""
        self._sloped: SlopedSkill | None = None
        if configuration.compensation.slopes:
            from daemon.compensation import sloped_skill  # noqa: PLC0415 (loaded where there are slopes)

            self._sloped = sloped_skill.SlopedSkill(configuration, self._axes, say)

    def stand(self, sample: CncSample) -> None:
        """Take where the axes stand at a poll of the CNC."""
        if self._sloped is not None:
            self._sloped.take(sample)

    def count_from(self, reference_id: str | None, model_id: str | None) -> None:
        if (reference_id, model_id) != self._counted:
            self._counted = (reference_id, model_id)
            self._records, self._zero, self._inhibit, self._judged = {}, {}, None, True

    def displacement(
        self, sample: DisplacementSample, estimate: ThermalErrorEstimate | None, applied_um: FloatArray
    ) -> None:
        """Take one row; a channel's first value since the reference is where it counts from."""
        if estimate is None or estimate.reference_id is None or not self._column:
            return
        if abs(apart_s := sample.utc_s - estimate.trace.last_byte.utc_s) > self._one_time_s:
            if not self._told:
                self._say(
                    f"displacements {apart_s:.0f} s apart from the estimate are not judged: where the logger writes "
                    "now, correct its time zone or one of the clocks"
                )
            self._told = True
            return
        self.count_from(estimate.reference_id, estimate.model_id)
        estimated_um = nose_errors_um(self._sources, estimate)
        for axis, column in self._column.items():
            i = self._axes.index(axis)
            now, place = (float(sample.um[column]), float(estimated_um[i]), float(applied_um[i])), 0
            if not np.isfinite(now).all():
                continue
            if self._sloped is not None:
                if (there := self._sloped.there(axis, sample.utc_s, estimated_um, applied_um)) is None:
                    continue
                now, place = (now[0], now[1] + there.estimated_um, now[2] + there.applied_um), there.place
            um, estimated, applied = zero = self._zero.setdefault((axis, place), now)
            if now is not zero:
                self._take(axis, (now[0] - um) - (now[2] - applied), now[1] - estimated)

    def probe(self, sample: ProbeSample, memory: OutputMemory, inputs: OutputInputs) -> None:
        """Take a probe value: without what is applied beyond the reference's baseline it is the error."""
        self.count_from(sample.reference_id, memory.model_id)
        since_baseline_um = sample.applied_um - float(memory.baseline_um[self._axes.index(sample.axis)])
        estimated_um = sample.thermal_error_um
        if self._sloped is not None:
            of_slopes = (inputs.error_of_tool_point_um, inputs.applied_um - memory.baseline_um)
            if (there := self._sloped.there(sample.axis, sample.time.utc_s, *of_slopes)) is None:
                return
            since_baseline_um, estimated_um = since_baseline_um + there.applied_um, estimated_um + there.estimated_um
        self._take(sample.axis, sample.deviation_um - since_baseline_um, estimated_um)

    def inhibit(self) -> Inhibit | None:
        """Return why the model must not be followed any more, None while it does no harm."""
        if not self._judged:
            self._inhibit, self._judged = self._verdict(), True
        return self._inhibit

    def _verdict(self) -> Inhibit | None:
        for axis, record in self._records.items():
            if does_harm(record, self._least_error_um):
                left_um, without_um = rms_um(record.left_um), rms_um(record.measured_um)
                return Inhibit(
                    code=InhibitCode.HARM,
                    text=f"axis {axis}: {len(record.left_um)} measurements since the reference show {left_um:.1f} um "
                    f"left by the estimate where {without_um:.1f} um would be without it",
                    remedy="position the work again, or release another model",
                )
        return None

    def _take(self, axis: str, measured_um: float, estimated_um: float) -> None:
        record = self._records.get(axis, SkillRecord())
        self._records[axis] = with_measurement(record, float(measured_um), float(estimated_um))
        self._judged = False
