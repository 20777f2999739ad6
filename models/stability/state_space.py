"""Modes as first-order equations, with their exact motion over a time (matrix exponential)."""

from dataclasses import dataclass

import numpy as np

from models.errors import StabilityError
from models.records import FloatArray
from models.stability.response import ModalResponse, Mode, feed_rotation

STILL = 1e-12
"""An output smaller than this share of the largest does not move."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StateSpace:
    """q' = A q + B F, d = C q, with two states per mode."""

    modes: tuple[Mode, ...]
    inputs: FloatArray
    """B, shape (n_states, 2), per force along and across the feed [N]."""
    outputs: FloatArray
    """C, shape (n_directions, n_states), displacement in the directions that can move [m]."""
    directions: tuple[int, ...]
    """Which of feed (0) and normal (1) can move."""

    def transition(self, time_s: FloatArray) -> FloatArray:
        """Return exp(A t), shape (..., n_states, n_states), for times of any shape [s]."""
        times = np.asarray(time_s, dtype=np.float64)
        matrix = np.zeros((*times.shape, 2 * len(self.modes), 2 * len(self.modes)))
        for number, mode in enumerate(self.modes):
            place = slice(2 * number, 2 * number + 2)
            matrix[..., place, place] = _transition(mode, times)
        return matrix


def _transition(mode: Mode, times: FloatArray) -> FloatArray:
    """Return exp(A t) of one mode, shape (..., 2, 2); complex arithmetic holds above critical damping."""
    angular = mode.angular_rad_s
    decay = mode.damping_ratio * angular
    damped = np.sqrt(complex(angular**2 - decay**2))
    phase = damped * times
    cosine = np.cos(phase).real
    sine = (times * np.sinc(phase / np.pi)).real
    fading = np.exp(-decay * times)
    rows = [
        [cosine + decay * sine, sine],
        [-(angular**2) * sine, cosine - decay * sine],
    ]
    matrix: FloatArray = fading[..., None, None] * np.moveaxis(np.array(rows), (0, 1), (-2, -1))
    return matrix


def state_space(response: ModalResponse, feed_deg: float = 0.0) -> StateSpace:
    """Return a modal response as state space in feed axes.

    Result: two states per mode. Raises StabilityError when nothing can move.

    `response`: modes per entry of the receptance matrix, in machine axes. `feed_deg`: direction of the feed against X
    [deg].
    """
    modes: list[Mode] = []
    inputs: list[FloatArray] = []
    outputs: list[FloatArray] = []
    for displacement, force, entry in response.entries():
        for mode in entry:
            modes.append(mode)
            into, out = np.zeros((2, 2)), np.zeros((2, 2))
            into[1, force] = 1.0
            out[displacement] = mode.displacement_gain_per_kg, mode.velocity_gain_s_per_kg
            inputs.append(into)
            outputs.append(out)
    if not modes:
        raise StabilityError("both directions are rigid, so no cut can chatter; give modes or an FRF for one")
    turn = feed_rotation(feed_deg)
    turned = turn @ np.hstack(outputs)
    size = np.abs(turned).max(axis=1)
    directions = tuple(int(i) for i in np.flatnonzero(size > STILL * size.max()))
    return StateSpace(
        modes=tuple(modes),
        inputs=np.vstack(inputs) @ turn.T,
        outputs=turned[list(directions)],
        directions=directions,
    )
