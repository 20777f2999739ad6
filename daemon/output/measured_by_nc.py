"""Tool settings and probe values of the NC program, until they have taken effect."""

from dataclasses import replace

import numpy as np

from daemon.history.writer import HistoryWriter
from daemon.output.skill_watch import SkillWatch
from models.output import OutputInputs, OutputMemory
from models.records import FloatArray, ProbeSample

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
