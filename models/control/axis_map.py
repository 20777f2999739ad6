"""From model channels to machine axes: the spindle nose plus the tool."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from models.records import FloatArray, ThermalErrorEstimate
from models.thermal.bias import Wander


@dataclass(frozen=True, slots=True, kw_only=True)
class ToolTerm:
    """Expansion of the tool between the spindle nose and the tool point."""

    length_mm: float
    expansion_um_per_m_k: float
    label_weights: Mapping[str, float]
    """Labels of the sensors whose weighted mean stands for the tool's temperature."""
    direction: int
    """+1 or -1: where a longer tool moves its point."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AxisSource:
    """Which estimate is the thermal error of one axis."""

    axis: str
    channel: str | None
    """Model channel, None for an axis without a model."""
    tool_term: ToolTerm | None = None


def tool_expansion_um(term: ToolTerm, label_increment_degc: Mapping[str, float]) -> float:
    """Return how far the tool point has moved by the tool's own expansion since the reference.

    Result: movement along the axis [um]; NaN when a label is missing. Linear expansion, dL = alpha L dT.

    `term`: length [mm], expansion coefficient [um/(m K)], weights and direction. `label_increment_degc`: change of each
    label's mean since the reference [degC].
    """
    increment = sum(weight * label_increment_degc.get(label, np.nan) for label, weight in term.label_weights.items())
    return float(term.direction * term.expansion_um_per_m_k * term.length_mm * 1e-3 * increment)


def nose_errors_um(sources: Sequence[AxisSource], estimate: ThermalErrorEstimate) -> FloatArray:
    """Return the thermal error of the spindle nose per axis since the reference.

    Result: of shape (n_axes,): actual minus nominal [um]; NaN for an axis without a channel in the estimate.

    `sources`: one per axis, in the machine's order. `estimate`: thermal error per model channel [um].
    """
    by_channel = dict(zip(estimate.channels, estimate.thermal_error_um.tolist(), strict=True))
    errors = (np.nan if source.channel is None else by_channel.get(source.channel, np.nan) for source in sources)
    return np.array(list(errors), dtype=np.float64)


def probe_wander(sources: Sequence[AxisSource], estimate: ThermalErrorEstimate | None) -> Wander | None:
    """Return how what the model misses wanders per axis; None: unknown.

    An axis without a channel wanders infinitely: a probe resets its offset, which then stays.
    """
    if estimate is None or estimate.probe_wander is None:
        return None
    by_channel = dict(zip(estimate.channels, zip(*estimate.probe_wander, strict=True), strict=True))
    found = [by_channel.get(one.channel or "", (np.inf, np.inf)) for one in sources]
    um2_per_min, correlation_min = np.array(found, dtype=np.float64).reshape(-1, 2).T
    return Wander(um2_per_min=um2_per_min, correlation_min=correlation_min)


def tool_terms_um(
    sources: Sequence[AxisSource],
    label_increment_degc: Mapping[str, float],
    label_begin_degc: Mapping[str, float],
    before_um: Mapping[str, float],
) -> FloatArray:
    """Return the expansion of the tool in the spindle per axis since its term began.

    Result: of shape (n_axes,): movement along the axis [um]; 0 for an axis without a tool term, NaN when a label is
    missing.

    `sources`: one per axis, in the machine's order. `label_increment_degc`: change of each label's mean since the
    reference [degC]. `label_begin_degc`: what that change was when the tool came into the spindle [degC]; empty: it was
    there at the reference. `before_um`: what an axis had expanded before [um].
    """
    since = {label: value - label_begin_degc.get(label, 0.0) for label, value in label_increment_degc.items()}
    expanding = ((s.tool_term, before_um.get(s.axis, 0.0)) for s in sources)
    terms = (0.0 if term is None else before + tool_expansion_um(term, since) for term, before in expanding)
    return np.array(list(terms), dtype=np.float64)
