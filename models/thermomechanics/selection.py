"""Chooses the temperatures that explain the bearings: groups of like signals, and the best of each."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from models.records import FloatArray

ALIKE = 0.9
"""Signals with a larger coefficient of correlation belong to one group (section 5.3.1)."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SignalSelection:
    """Correlations and what was chosen by them."""

    candidates: tuple[str, ...]
    autocorrelation: FloatArray
    """Coefficients between the signals, shape (m, m) (Fig. 5-10)."""
    properties: tuple[str, ...]
    """Property and axis, such as 'kt_34 x'."""
    crosscorrelation: FloatArray
    """Coefficients between signals and properties, shape (m, p) (Fig. 5-11)."""
    groups: tuple[tuple[str, ...], ...]
    """Signals that are alike."""
    chosen: tuple[str, ...]
    """Of each group the signal that correlates best with the properties."""


def correlation(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return coefficients of correlation between columns.

    Result: shape (p, q); 0 for a column that does not move.

    `first` and `second`: shapes (n, p) and (n, q), without NaN.
    """

    def standardised(table: FloatArray) -> FloatArray:
        """Return the columns without their means, scaled to unit length."""
        centred = table - table.mean(axis=0)
        size = np.sqrt(np.sum(centred**2, axis=0))
        return np.asarray(centred / np.where(size > 0.0, size, np.inf), dtype=np.float64)

    return np.asarray(standardised(first).T @ standardised(second), dtype=np.float64)


def select_signals(
    candidates: Sequence[str],
    degc: FloatArray,
    properties: Sequence[str],
    values: FloatArray | None,
    crosscorrelation: FloatArray | None = None,
) -> SignalSelection:
    """Choose one signal of every group of like ones.

    Signals are taken in the order of their mean absolute correlation with the properties; one that is like a signal
    taken before joins its group.

    `candidates`: names of the signals. `degc`: their temperatures [degC], shape (n, m). `properties`: names of the
    properties. `values`: shape (n, p), SI units; None with `crosscorrelation`. `crosscorrelation`: coefficients between
    signals and properties, shape (m, p), where they are known already.
    """
    auto = correlation(degc, degc)
    if crosscorrelation is not None:
        cross = crosscorrelation
    else:
        cross = correlation(degc, np.zeros((len(degc), 0)) if values is None else values)
    order = np.argsort(-np.mean(np.abs(cross), axis=1), kind="stable")
    groups: dict[int, list[int]] = {}
    for index in order.tolist():
        leader = next((each for each in groups if abs(auto[each, index]) > ALIKE), None)
        groups.setdefault(index if leader is None else leader, []).append(index)
    chosen = sorted(groups)
    return SignalSelection(
        candidates=tuple(candidates),
        autocorrelation=auto,
        properties=tuple(properties),
        crosscorrelation=cross,
        groups=tuple(tuple(candidates[index] for index in groups[leader]) for leader in chosen),
        chosen=tuple(candidates[leader] for leader in chosen),
    )
