"""Compares the estimate with displacements and probe values while the daemon runs, and inhibits one that does harm."""

from collections.abc import Sequence

import numpy as np

from config.schema import Configuration
from models.control.axis_map import AxisSource, nose_errors_um
from models.control.inhibit import Inhibit, InhibitCode
from models.control.state import OutputMemory
from models.records import DisplacementSample, FloatArray, ProbeSample, ThermalErrorEstimate
from models.thermal.skill import SkillRecord, does_harm, rms_um, with_measurement


class SkillWatch:
    """Compares measured with estimated errors since the reference; owned by the control task.

    A displacement channel belongs to the axis whose estimate has its name. It is taken to feel what the
    NC applies, so measured minus applied is the error without compensation.
    """

    def __init__(self, sources: Sequence[AxisSource], configuration: Configuration) -> None:
        displacements = configuration.displacements
        channels = [channel.name for channel in displacements.channels] if displacements is not None else []
        self._sources = tuple(sources)
        self._axes = tuple(source.axis for source in sources)
        self._column = {s.axis: channels.index(s.channel) for s in sources if s.channel and s.channel in channels}
        self._least_error_um = configuration.compensation.output.harm_above_um
        self._counted: tuple[str | None, str | None] = (None, None)
        self._records: dict[str, SkillRecord] = {}
        self._inhibit: Inhibit | None = None
        self._judged = True
        """Whether that is the verdict on the latest measurement."""
        self._zero: tuple[FloatArray, FloatArray, FloatArray] | None = None

    def count_from(self, reference_id: str | None, model_id: str | None) -> None:
        """Begin anew with every reference and every model."""
        if (reference_id, model_id) != self._counted:
            self._counted = (reference_id, model_id)
            self._records, self._zero, self._inhibit, self._judged = {}, None, None, True

    def displacement(
        self, sample: DisplacementSample, estimate: ThermalErrorEstimate | None, applied_um: FloatArray
    ) -> None:
        """Take one row of the logger; the first one since the reference is where it counts from."""
        if estimate is None or estimate.reference_id is None or not self._column:
            return
        self.count_from(estimate.reference_id, estimate.model_id)
        estimated_um = nose_errors_um(self._sources, estimate)
        if self._zero is None:
            if np.all(np.isfinite(applied_um)):
                self._zero = (sample.um, estimated_um, applied_um)
            return
        um, estimated, applied = self._zero
        for axis, column in self._column.items():
            i = self._axes.index(axis)
            measured = (sample.um[column] - um[column]) - (applied_um[i] - applied[i])
            self._take(axis, measured, estimated_um[i] - estimated[i])

    def probe(self, sample: ProbeSample, memory: OutputMemory) -> None:
        """Take a probe value: without what is applied beyond the reference's baseline it is the error."""
        self.count_from(sample.reference_id, memory.model_id)
        since_baseline_um = sample.applied_um - float(memory.baseline_um[self._axes.index(sample.axis)])
        self._take(sample.axis, sample.deviation_um - since_baseline_um, sample.thermal_error_um)

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
