"""Extrapolates a displacement under constant rotation: a sum of first-order responses fitted to what was measured."""

from dataclasses import dataclass

import numpy as np

from models.recordings.dataset import DatasetError
from models.records import FloatArray

TIME_CONSTANTS_MIN = (3.0, 8.0, 20.0, 50.0, 120.0, 300.0)
"""Of the responses [min]; those longer than the measured period are left out, for nothing tells them apart."""
RELATIVE_PENALTY = 1e-4
"""Ridge on the amplitudes, per row: responses that the period cannot tell apart share what there is."""
HORIZON_MIN = 1440.0
FEWEST_ROWS = 10


@dataclass(frozen=True, slots=True, kw_only=True)
class WarmUp:
    """Displacement under constant rotation: offset + sum of a_i (1 - exp(-t / tau_i))."""

    time_constants_min: FloatArray
    """tau_i [min], shape (n,)."""
    amplitudes_um: FloatArray
    """a_i [um], shape (n,)."""
    rmse_um: float
    """How well it fits what was measured [um]."""

    def drift_um(self, at_min: FloatArray, ahead_min: float) -> FloatArray:
        """Return the expected change over the next minutes.

        Result of shape (m,): later minus now [um].

        `at_min`, shape (m,): times since the start of rotation [min]. `ahead_min`: how far ahead [min].
        """
        left = np.exp(-np.divide.outer(at_min, self.time_constants_min))
        change: FloatArray = (left * -np.expm1(-ahead_min / self.time_constants_min)) @ self.amplitudes_um
        return change

    def wait_min(self, *, ahead_min: float, tolerance_um: float) -> float:
        """Return how long to warm up until the expected drift stays below a tolerance.

        Result: since the start of rotation [min], in whole minutes; NaN when it is not reached within a day.

        `ahead_min`: time ahead over which the drift counts [min]. `tolerance_um`: largest drift in it [um].
        """
        at_min = np.arange(HORIZON_MIN + 1.0)
        moving = np.flatnonzero(np.abs(self.drift_um(at_min, ahead_min)) > tolerance_um)
        if not len(moving):
            return 0.0
        after = int(moving[-1]) + 1
        return float(at_min[after]) if after < len(at_min) else float("nan")


def fit_warm_up(time_min: FloatArray, error_um: FloatArray) -> WarmUp:
    """Fit the responses to a rotation at constant speed.

    Result: by least squares with a small penalty on the amplitudes. Raises DatasetError when fewer than `FEWEST_ROWS`
    rows were measured, or the period is shorter than every time constant.

    `time_min`, shape (n,): time since the start of rotation [min]; the first row is the reference at standstill, which
    only says where it began: the jump at spindle on is an offset of all rows after it. `error_um`, shape (n,):
    displacement [um], NaN where it was not measured.
    """
    known = np.isfinite(error_um)
    known[0] = False
    times, values = time_min[known] - time_min[0], error_um[known]
    if len(times) < FEWEST_ROWS or times[-1] < TIME_CONSTANTS_MIN[0]:
        raise DatasetError(
            f"{len(times)} rows over {times[-1] if len(times) else 0.0:.3g} min of constant rotation say nothing about "
            f"how it goes on; at least {FEWEST_ROWS} rows over {TIME_CONSTANTS_MIN[0]:g} min are needed"
        )
    constants = np.array([each for each in TIME_CONSTANTS_MIN if each <= times[-1]])
    responses = -np.expm1(-np.divide.outer(times, constants))
    table = np.column_stack([np.ones(len(times)), responses])
    penalty = np.hstack(
        [np.zeros((len(constants), 1)), np.sqrt(RELATIVE_PENALTY * len(times)) * np.eye(len(constants))]
    )
    solution = np.linalg.lstsq(
        np.vstack([table, penalty]), np.concatenate([values, np.zeros(len(constants))]), rcond=None
    )[0]
    return WarmUp(
        time_constants_min=constants,
        amplitudes_um=np.asarray(solution[1:], dtype=np.float64),
        rmse_um=float(np.sqrt(np.mean(np.square(values - table @ solution)))),
    )
