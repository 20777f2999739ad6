"""What a probe value is worth, as the record that reaches the history."""

import numpy as np

from models.baseline import probe_objection
from models.compensation import why_not_ready
from models.output import OutputInputs, OutputLimits, OutputMemory
from models.records import FloatArray, Instant, ProbeSample


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
