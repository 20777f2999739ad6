"""Tool settings and probe values of the NC program, until they have taken effect."""

from dataclasses import replace

import numpy as np

from daemon.compensation.skill_monitor import SkillWatch
from daemon.history.writer import HistoryWriter
from models.control.baseline import probe_objection
from models.control.compensation import why_not_ready
from models.control.state import OutputInputs, OutputLimits, OutputMemory
from models.records import FloatArray, Instant, ProbeSample

LOST = "the link to the CNC was lost before it took effect; ask again"


class MeasuredByNc:
    """Holds what the next step is to take up; owned by the control task."""

    def __init__(self, history: HistoryWriter, skill: SkillWatch) -> None:
        self._history = history
        self._skill = skill
        self._probe: ProbeSample | None = None
        self.tool_setting: tuple[bool, ...] | None = None
        self.probe_um: FloatArray | None = None

    def probed(self, sample: ProbeSample, deviations_um: FloatArray) -> str:
        """Take a probe value; a refused one reaches the history at once. Return why it is refused."""
        if sample.accepted:
            self._probe, self.probe_um = sample, deviations_um
        else:
            self._history.probe(sample)
        return sample.reason

    def settle(self, inputs: OutputInputs, memory: OutputMemory) -> str:
        """See after a step whether it took effect; return why not, '' when it did or when there was nothing."""
        if self.tool_setting is None and self._probe is None:
            return ""
        effective = inputs.link and bool(np.all(np.isfinite(inputs.applied_um))) and memory.reference_id is not None
        if self._probe is not None:
            self._history.probe(self._probe if effective else replace(self._probe, accepted=False, reason=LOST))
            if effective:
                self._skill.probe(self._probe, memory)
        self.tool_setting = self.probe_um = self._probe = None
        return "" if effective else LOST


def judged_probe(
    memory: OutputMemory | None,
    inputs: OutputInputs,
    limits: OutputLimits,
    *,
    axis: str,
    deviation_um: float,
    now: Instant,
) -> tuple[ProbeSample, FloatArray]:
    """Return the record of a probe value, taken or refused, and the deviation per axis [um]."""
    index = limits.axes.index(axis)
    deviations = np.full(len(limits.axes), np.nan)
    deviations[index] = deviation_um
    refusal = "the CNC has not been reached yet"
    if memory is not None:
        obstacle = why_not_ready(memory, inputs, limits)
        refusal = probe_objection(memory, inputs, limits, obstacle, deviations)
    sample = ProbeSample(
        time=now,
        axis=axis,
        deviation_um=deviation_um,
        applied_um=float(inputs.applied_um[index]),
        thermal_error_um=float(inputs.error_of_tool_point_um[index]),
        reference_id=inputs.reference_id,
        accepted=not refusal,
        reason=refusal,
    )
    return sample, deviations
