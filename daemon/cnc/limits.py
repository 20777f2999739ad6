"""Turns axes, bounds and commissioned factors of the configuration into arrays and records for the control law."""

import hashlib
import json
from collections.abc import Mapping, Sequence

import numpy as np

from config.records.commissioning import CommissioningRecord
from config.schema import Configuration
from config.schema.compensation import ToolTermConfig
from config.schema.guard import PROGRAM_LABELS
from daemon.cnc.macro_block import ECHO_SLACK_UM
from daemon.cnc.own_offset import offset_macros
from models.cleanse import HELD_PERIODS
from models.control.axis_map import AxisSource, ToolTerm
from models.control.reference_records import ReferenceRules
from models.control.state import OutputLimits
from models.units import um_from_mm

ROUNDING = 0.51
"""Half an increment, and a little for the arithmetic."""
DWELL_POLLS = 2.0
"""Where nothing is said of it, the program stands at a positioning block for so many poll periods."""
ANSWER_REAL_S = 5.0
"""A reference that was asked for comes within this time, or not at all [s of the wall clock]."""
PAUSE_REAL_S = 0.5
"""On a clock that runs ahead a shorter gap between polls is this computer's, not the link's [s of the wall clock]."""


class CommissionedFactors(dict[str, float]):
    """Movement per macro value by axis: sign times scale, as the record takes them to be."""

    def __init__(self, record: CommissioningRecord | None, axes: Sequence[str]) -> None:
        of_axes = {} if record is None else record.axes
        proved = {axis: of_axes[axis] for axis in axes if axis in of_axes}
        super().__init__({axis: found.sign * found.scale for axis, found in proved.items()})
        self.excess = {
            axis: max(1.0, abs(found.measured_um / found.written_um) / found.scale) for axis, found in proved.items()
        }
        """Measured movement over the movement that sign and scale make of the value, where it was more."""


def output_limits(configuration: Configuration, factors: Mapping[str, float] | None = None) -> OutputLimits:
    """Return the limits of the output, one row per axis.

    `factors` is the movement per macro value. The guard bounds the macro value, so where less moves
    than is written, bound and step of the movement shrink with it. Where the axis was measured to move
    further than sign and scale say, bound, step and slew rate shrink by as much, so that what moves
    stays within the configured limits. The bound is a whole number of the control's increments, which rounds.
    """
    axes = configuration.compensation.outputs
    excess = factors.excess if isinstance(factors, CommissionedFactors) else {}
    certain = np.array([1.0 / excess.get(axis, 1.0) for axis in axes])
    moves = np.array([abs((factors or {}).get(axis, 1.0)) for axis in axes])
    share, increment_um = np.minimum(certain, moves), moves * um_from_mm(configuration.cnc.guard.increment_mm)
    bound_um = share * [axis.absolute_bound_um for axis in axes.values()]
    output, noise_um = configuration.compensation.output, configuration.compensation.reference.probe_noise_um
    return OutputLimits(
        axes=tuple(axes),
        absolute_bound_um=np.minimum(bound_um, np.floor(bound_um / increment_um + 1e-6) * increment_um),
        slew_um_per_min=certain * [axis.slew_um_per_min for axis in axes.values()],
        step_um=share * [axis.step_um for axis in axes.values()],
        rounding_um=np.maximum(ECHO_SLACK_UM, ROUNDING * increment_um),
        deadband_um=np.array([axis.deadband_um for axis in axes.values()]),
        stale_after_s=max(output.stale_after_s, HELD_PERIODS * configuration.temperatures.shortest_period_s),
        hold_limit_s=output.hold_limit_s,
        min_confidence=output.min_confidence,
        full_confidence=output.full_confidence,
        probe_bound_um=configuration.compensation.reference.probe_bound_um,
        probe_noise_um=float("nan") if noise_um is None else noise_um,
    )


def axis_sources(configuration: Configuration) -> tuple[AxisSource, ...]:
    """Return which estimate feeds which axis."""
    axes = configuration.compensation.axes.items()
    return tuple(AxisSource(axis=n, channel=axis.estimate, tool_term=_tool_term(axis.tool_term)) for n, axis in axes)


def _tool_term(term: ToolTermConfig | None) -> ToolTerm | None:
    if term is None:
        return None
    kept = term.model_dump(include={"length_mm", "expansion_um_per_m_k", "direction"})
    return ToolTerm(label_weights=term.temperatures, **kept)


def guard_programs(configuration: Configuration) -> frozenset[int]:
    """Return the O numbers of the NC programs that part programs call for us: the guard's, and the speed program."""
    speed = configuration.spindle_speed
    return frozenset(configuration.cnc.guard.programs) | ({speed.program} if speed is not None else set())


def reference_rules(
    configuration: Configuration, clock_speed: float, um_per_unit: Mapping[str, float]
) -> ReferenceRules:
    """Return where the work is positioned, and which gap between two polls may hide that."""
    reference = configuration.compensation.reference
    dwell_s = reference.positioning_dwell_s or DWELL_POLLS * configuration.cnc.poll_period_s
    if clock_speed != 1.0:  # only the simulated machine takes such a clock
        dwell_s = max(dwell_s, PAUSE_REAL_S * clock_speed)
    return ReferenceRules(
        program=reference.program,
        sequence_numbers=frozenset(reference.sequence_numbers),
        zero_first=reference.policy == "zero_first",
        retreat_sequence_numbers=frozenset(reference.retreat_sequence_numbers),
        positioning_dwell_s=dwell_s,
        positioning_counter=reference.positioning_counter,
        answer_within_s=ANSWER_REAL_S * clock_speed,
        max_outage_s=reference.max_outage_s,
        guard_programs=guard_programs(configuration),
        guard_blocks=PROGRAM_LABELS,
        counts_with=_counts_with(configuration, um_per_unit),
    )


def _counts_with(configuration: Configuration, um_per_unit: Mapping[str, float]) -> dict[str, str]:
    """Return what the numbers mean that are kept of a reference: they stand in the order of the sensors."""
    temperatures = configuration.temperatures
    inputs = json.dumps([*temperatures.reads.items(), *configuration.cnc.reads.items()])
    marks = {
        "what sensors or the control read, or the list of them": hashlib.sha256(inputs.encode()).hexdigest(),
        "the commissioned movement per macro value": json.dumps(dict(um_per_unit)),
    }
    for name, axis in configuration.compensation.axes.items():
        term = axis.tool_term
        of_tool = () if term is None else (term.model_dump(), [*map(temperatures.labels.get, term.temperatures)])
        marks[f"what axis {name} follows, or its tool term"] = json.dumps([axis.estimate, of_tool])
    return marks


def also_polled(configuration: Configuration) -> tuple[int, ...]:
    """Return what is polled beside the block: the macros that count positionings and tools, and the external offset."""
    reference = configuration.compensation.reference
    counters = (reference.positioning_counter, reference.tool_counter)
    return (*(number for number in counters if number is not None), *offset_macros(configuration))
