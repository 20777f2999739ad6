"""Made-up years of probe values of a machine whose model wears out, or does not.

Each working day has probe values; what the model leaves of the error is its share of it, with a day's own factor that
wanders (jobs, tools, coolant), a swing over the year, noise of the probe, and now and then a chip under the probe.
"""

from dataclasses import dataclass

import numpy as np

from models.records import FloatArray


@dataclass(frozen=True, kw_only=True)
class Year:
    time_d: FloatArray
    without_um: FloatArray
    left_um: FloatArray

    def until(self, day: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        now = self.time_d < day
        return self.time_d[now], self.without_um[now], self.left_um[now]


def wandering(rng: np.random.Generator, days: int, deviation: float, days_alike: float) -> FloatArray:
    keep = np.exp(-1.0 / days_alike)
    steps = rng.normal(0.0, deviation * np.sqrt(1.0 - keep**2), days)
    values, value = np.empty(days), rng.normal(0.0, deviation)
    for day in range(days):
        value = keep * value + steps[day]
        values[day] = value
    return values


def year(seed: int, first: float, last: float, *, from_d: float = 0.0, days: int = 365) -> Year:
    """The share goes from `first` to `last` in a line that begins at a day."""
    rng = np.random.default_rng(seed)
    day = np.arange(days)
    share = first + (last - first) * np.clip((day - from_d) / (days - from_d), 0.0, None)
    phase = rng.uniform(0.0, 2.0 * np.pi)
    share = share * (1.0 + 0.1 * np.sin(2.0 * np.pi * day / 365.0 + phase)) * np.exp(wandering(rng, days, 0.25, 3.0))
    amplitude_um = 15.0 * np.exp(wandering(rng, days, 0.3, 5.0))
    holiday = rng.integers(60, days - 30)
    worked = (day % 7 < 5) & ~((day >= holiday) & (day < holiday + 14))
    of_probe = np.repeat(day[worked], rng.poisson(6.0, int(worked.sum())))
    without = amplitude_um[of_probe] * rng.normal(0.6, 0.8, len(of_probe))
    size = np.abs(amplitude_um[of_probe])
    left = share[of_probe] * size * rng.normal(0.0, 1.0, len(of_probe)) + rng.normal(0.0, 1.0, len(of_probe))
    chip = rng.random(len(of_probe)) < 0.005
    left = np.where(chip, 40.0, left)
    return Year(time_d=of_probe + rng.random(len(of_probe)) * 0.9, without_um=without, left_um=left)
