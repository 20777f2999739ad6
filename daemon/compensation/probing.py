"""Tool settings and probe values of the NC program, until they have taken effect."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import isnan

import numpy as np

from daemon.cnc.events import Journal
from daemon.cnc.macro_block import ECHO_SLACK_UM, Echo
from daemon.compensation.references import References
from daemon.compensation.skill_monitor import SkillWatch
from daemon.compensation.tool import ToolInSpindle
from daemon.history.writer import HistoryWriter
from models.control.compensation import first_inhibit
from models.control.probe_values import probe_inhibit, tool_setting_inhibit
from models.control.state import Inhibit, InhibitCode, OutputInputs, OutputLimits, OutputMemory
from models.records import CncSample, FloatArray, Instant, ProbeSample, ThermalErrorEstimate

LOST = "the link to the CNC was lost before it took effect; ask again"
FAULTY = "the output went into FAULT before it took effect; acknowledge the fault, then measure again"
GUARD_BETWEEN_S = 1.0
"""A guard that moved so shortly before the program asks has moved since it measured, which takes longer [s]; when
between two polls it asked, nobody knows."""
GUARD_BETWEEN = "the guard moved the axes between measuring and asking: call it before you measure, and measure again"


@dataclass(frozen=True, slots=True, kw_only=True)
class OutputNow:
    """Where the output stands while a request of the NC program is served."""

    memory: OutputMemory | None
    estimate: ThermalErrorEstimate | None
    inputs: OutputInputs
    now: Instant


class MeasuredByNc:
    """Takes what the NC program says of tools and probes, and holds it for the next step; owned by the control task."""

    def __init__(
        self,
        limits: OutputLimits,
        history: HistoryWriter,
        journal: Journal,
        skill: SkillWatch,
        references: References,
        look: Callable[[], OutputNow],
    ) -> None:
        self._limits = limits
        self._history = history
        self._journal = journal
        self._skill = skill
        self._references = references
        self._look = look
        self._probe: ProbeSample | None = None
        self.tool = ToolInSpindle(references)
        self._polled_s: float | None = None
        self._polled: tuple[float, Echo] | None = None
        """CNC clock [s] and echo of the latest poll."""
        self._asked_after_s = -np.inf
        """What is asked for in the latest poll came after this, on the CNC's clock [s]."""
        self._moved_s = -np.inf
        """When the guard moved an axis last, on the CNC's clock [s]."""
        self.tool_setting: tuple[bool, ...] | None = None
        self.probe_um: FloatArray | None = None

    def on_sample(self, sample: CncSample, echo: Echo, estimate: ThermalErrorEstimate | None) -> None:
        """Take one poll: the tool in the spindle, where the axes stand, and what the guard has done."""
        before, self._polled = self._polled, (sample.clock_s, echo)
        self._asked_after_s = min(np.inf if before is None else before[0], sample.clock_s - GUARD_BETWEEN_S)
        if before is not None and echo.time_s is not None and not _stood(before[1].applied_um, echo.applied_um):
            self._moved_s = echo.time_s
        now_s = sample.time.monotonic_s
        gap_s = self._references.away_s(sample) if self._polled_s is None else now_s - self._polled_s
        self._polled_s = now_s
        self.tool.on_sample(sample.tool_number, estimate, gap_s, self._references.tool_count)
        self._skill.stand(sample)

    def set_tool(self, axis: str) -> str:
        """Make what is applied the baseline of the tool in the spindle; return why it is refused."""
        if (unknown := self.tool.unknown()) is not None:
            return f"the tool cannot be set: {unknown}"
        if self._guard_between:
            return GUARD_BETWEEN
        output = self._look()
        if refusal := _tool_setting_refusal(output.memory, output.inputs, self._limits):
            return refusal
        self.tool_setting = tuple(name == axis for name in self._limits.axes)
        return ""

    def change_tool(self, tool_number: int) -> None:
        """Take the tool that the NC program names into the spindle."""
        self.tool.name(tool_number, self._look().estimate)
        self._journal.say("tool", f"T{tool_number} in the spindle")

    def inhibits(self) -> tuple[Inhibit | None, Inhibit | None]:
        """Return what probes say against the model, and why the tool in the spindle is not known."""
        return self._skill.inhibit(), self.tool.inhibit()

    def take_probe(self, axis: str, deviation_um: float) -> str:
        """Let a probe value correct the estimate, or return why not; it reaches the history either way."""
        output = self._look()
        sample, deviations = judged_probe(
            output.memory, output.inputs, self._limits, axis=axis, deviation_um=deviation_um, now=output.now
        )
        if self._guard_between:
            sample = replace(sample, accepted=False, reason=GUARD_BETWEEN)
        if sample.accepted:
            self._probe, self.probe_um = sample, deviations
        else:
            self._history.probe(sample)
        return sample.reason

    @property
    def _guard_between(self) -> bool:
        """What the program measured was measured with another offset than the one that is applied now."""
        if self._polled is None:
            return False
        clock_s, echo = self._polled
        return not echo.settled or self._asked_after_s < self._moved_s < clock_s + GUARD_BETWEEN_S

    @property
    def waiting(self) -> bool:
        """Something was taken that the next step counts."""
        return self.tool_setting is not None or self._probe is not None

    def given_up(self, memory: OutputMemory, inputs: OutputInputs) -> str:
        """Give up what was taken before when this step's estimate or reference is none to count it from; return why."""
        if not self.waiting or inputs.output_fault is not None:
            return ""
        if not inputs.link or not np.isfinite(inputs.applied_um).all():
            return ""
        if (probe := self._probe) is not None:
            axis, deviation_um = probe.axis, probe.deviation_um
            now, _ = judged_probe(memory, inputs, self._limits, axis=axis, deviation_um=deviation_um, now=probe.time)
            lost = now.reason
        else:
            lost = _tool_setting_refusal(memory, inputs, self._limits)
        if lost:
            self.drop(lost)
        return lost

    def drop(self, why: str) -> None:
        """Let nothing that waits for a step count."""
        if self._probe is not None:
            self._history.probe(replace(self._probe, accepted=False, reason=why))
        self.tool_setting = self.probe_um = self._probe = None

    def settle(self, inputs: OutputInputs, memory: OutputMemory) -> str:
        """See after the write of a step if it took effect; return why not, '' when it did or nothing was taken."""
        if not self.waiting:
            return ""
        reached = inputs.link and bool(np.all(np.isfinite(inputs.applied_um))) and memory.reference_id is not None
        if lost := FAULTY if inputs.output_fault is not None else "" if reached else LOST:
            self.drop(lost)
            return lost
        if self._probe is not None:
            self._history.probe(self._probe)
            self._skill.probe(self._probe, memory, inputs)
        if self.tool_setting is not None:
            axis = self._limits.axes[self.tool_setting.index(True)]
            if axis in self._references.terms:  # one that is set on another axis goes on expanding along this
                output, others = self._look(), self._references.terms.keys() - {axis}
                um = () if output.inputs.tool_term_um is None else output.inputs.tool_term_um.tolist()
                before_um = {name: each for name, each in zip(self._limits.axes, um, strict=False) if name in others}
                self.tool.begin(self.tool.number, output.estimate, before_um=before_um)
            self._journal.say("tool", f"T{self.tool.number} set on axis {axis}")
        self.tool_setting = self.probe_um = self._probe = None
        return ""


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
        inhibit = first_inhibit(memory, inputs, limits)
        refusal = str(probe_inhibit(memory, inputs, limits, inhibit, deviations) or "")
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


def _stood(before_um: FloatArray, now_um: FloatArray) -> bool:
    """Tell whether the guard has moved no axis between two polls; one that was vacant and is has not moved."""
    axes = zip(before_um.tolist(), now_um.tolist(), strict=True)
    return all(was == now or abs(now - was) <= ECHO_SLACK_UM or (isnan(was) and isnan(now)) for was, now in axes)


def _tool_setting_refusal(memory: OutputMemory | None, inputs: OutputInputs, limits: OutputLimits) -> str:
    """Return why no tool can be set now, '' when it can; who may write to the CNC has no part in that."""
    if memory is None or inputs.reference_id is None:
        return "a tool setting counts from the work's reference, and there is none: position the work first"
    if inputs.estimate_reference_id != inputs.reference_id:
        return "there is no estimate since the work's reference yet; set the tool again after the next cycle"
    own = tuple(inhibit for inhibit in inputs.inhibits if inhibit.code is InhibitCode.MODEL)
    inputs = replace(inputs, inhibits=own)
    return str(tool_setting_inhibit(memory, inputs, limits, first_inhibit(memory, inputs, limits)) or "")
