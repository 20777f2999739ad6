"""Runs of a small machine on disk: a spindle on and off at several speeds, three sensors, two displacements."""

from pathlib import Path

import numpy as np

from models.records import FloatArray

MINUTES = 180
WEIGHTS = np.array([[4.0, 1.0], [-1.5, 2.0], [0.5, 0.5]])


def run(
    folder: Path, number: int, *, minutes: int = MINUTES, turned: bool = False, weights: FloatArray = WEIGHTS
) -> Path:
    """Write a run: the spindle on and off at several speeds, three sensors, two displacements with some noise."""
    rng = np.random.default_rng(number)
    speed = np.repeat(rng.choice([0.0, 2000.0, 4000.0, 6000.0], 9), 20)[:minutes]
    degc, body = np.zeros((minutes, 3)), np.zeros(3)
    for row in range(minutes):
        body = body + (np.array([8.0, 5.0, 2.0]) * speed[row] / 6000.0 - body) / np.array([25.0, 50.0, 120.0])
        degc[row] = body
    um = degc @ weights + rng.normal(0.0, 0.05, (minutes, 2))
    um[:, 0] *= -1.0 if turned else 1.0
    degc += 20.0 + rng.normal(0.0, 0.02, degc.shape)
    path = folder / f"run{number:02}.csv"
    table = np.column_stack([60.0 * np.arange(minutes), speed, degc, um])
    np.savetxt(path, table, delimiter=",", header="t,rpm,T1,T2,T3,c1,c2", comments="", fmt="%.9g")
    return path
