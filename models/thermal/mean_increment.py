"""The mean increment of some sensors since a reference, which does not jump when a sensor leaves or returns."""

from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from models.records import FloatArray

FADE_MIN = 0.5
"""Time constant [min]; a step of 20 um has 0.4 um left after two minutes. The slew rate limits what the tool does."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Fading:
    """What is added so that something goes on from where it was."""

    amount: FloatArray
    since_min: float = 0.0
    """When it was that much [min]."""

    def at(self, time_min: float) -> FloatArray:
        """Return what is left of it."""
        if not self.amount.any():
            return self.amount
        left: FloatArray = self.amount * np.exp(-max(time_min - self.since_min, 0.0) / FADE_MIN)
        return left


def hidden_step(before: FloatArray, after: FloatArray, time_min: float) -> Fading:
    """Return what lets a value go on from `before` though it is `after` from now on."""
    return Fading(amount=before - after, since_min=time_min)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MeanIncrement:
    """What the mean increment of some sensors since a reference counts from, so that no coming or going is a step."""

    reference_degc: FloatArray
    """What each sensor counts from [degC], shape (n_sensors,); NaN without a value yet."""
    counted: npt.NDArray[np.bool_]
    """Which sensors had a temperature of their own at the latest renewal."""
    offset_k: FloatArray
    """How far each sensor that is away is imputed above the mean of those that count [K]; NaN for those."""
    increment_k: FloatArray
    """Increment that each sensor counted with at the latest renewal [K]; NaN where it is not known."""
    rest: Fading = field(default_factory=lambda: Fading(amount=np.zeros(1)))
    """What is left of the step that the latest return would have been [K], shape (1,)."""
    time_min: float = 0.0
    """Of the latest renewal [min]."""

    @property
    def mean_k(self) -> float:
        """Mean increment since the reference [K]; NaN while no sensor has a temperature."""
        if not self.counted.any():
            return float("nan")
        return float(self.increment_k.sum() / len(self.increment_k) + self.rest.at(self.time_min)[0])


def first_mean_increment(reference_degc: FloatArray) -> MeanIncrement:
    """Return the mean increment at the reference.

    `reference_degc`, shape (n_sensors,): temperatures at the reference [degC], NaN where there is none. Such a sensor
    is imputed by the mean of the others; without any other the mean stays unknown.
    """
    known = np.isfinite(reference_degc)
    begin_k = 0.0 if known.any() else np.nan
    return MeanIncrement(
        reference_degc=reference_degc,
        counted=known,
        offset_k=np.where(known, np.nan, begin_k),
        increment_k=np.full(len(reference_degc), begin_k),
    )


def renewed_mean_increment(before: MeanIncrement, degc: FloatArray, time_min: float = 0.0) -> MeanIncrement:
    """Return the mean increment with new temperatures.

    A sensor that leaves is imputed from there on by the change of the mean increment of the others, or held where
    none is left; one that returns counts from the reference again, and the step that this would be fades out. One
    without a value at the reference counts on from where it was imputed.

    `before`: as it was. Increments that are not known (after a restart) are taken for the mean of the others. `degc`,
    shape (n_sensors,): temperatures now [degC], NaN where there is none. `time_min`: of now [min].
    """
    known = np.isfinite(degc)
    if known.all() and before.counted.all():  # no sensor leaves or returns: the usual case
        return MeanIncrement(
            reference_degc=before.reference_degc,
            counted=before.counted,
            offset_k=before.offset_k,
            increment_k=degc - before.reference_degc,
            rest=before.rest,
            time_min=time_min,
        )
    stayed, left = known & before.counted, before.counted & ~known
    if not stayed.any() and np.isnan(before.increment_k[left]).any():
        return before  # nothing is left to impute from, and where these were is not known
    offset_k = _offsets_without(before, stayed, left)
    imputed_k = np.where(stayed, degc - before.reference_degc, _mean(degc - before.reference_degc, stayed) + offset_k)
    if (known == before.counted).all():
        return replace(before, increment_k=imputed_k, time_min=time_min)
    reference_degc = np.where(known & np.isnan(before.reference_degc), degc - imputed_k, before.reference_degc)
    increment_k = np.where(known, degc - reference_degc, imputed_k)
    goes_on_k = np.array([imputed_k.mean()]) + before.rest.at(time_min)
    back = bool((known & ~before.counted).any()) and bool(np.isfinite(goes_on_k).all())
    return MeanIncrement(
        reference_degc=reference_degc,
        counted=known,
        offset_k=np.where(known, np.nan, increment_k - _mean(increment_k, known)),
        increment_k=increment_k,
        rest=hidden_step(goes_on_k, np.array([increment_k.mean()]), time_min) if back else before.rest,
        time_min=time_min,
    )


def _offsets_without(before: MeanIncrement, stayed: npt.NDArray[np.bool_], left: npt.NDArray[np.bool_]) -> FloatArray:
    """Return the offsets of all sensors that are away, from the mean of those that stayed [K]."""
    if not left.any():
        return before.offset_k
    offset_k = before.increment_k - _mean(before.increment_k, stayed)
    unknown_k = np.where(before.counted, 0.0, before.offset_k)
    return np.where(np.isfinite(offset_k), offset_k, unknown_k)


def _mean(values: FloatArray, which: npt.NDArray[np.bool_]) -> float:
    return float(values[which].mean()) if which.any() else 0.0
