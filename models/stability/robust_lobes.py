"""Limiting depths as a band, from what is not known exactly: cutting coefficients and modes.

Every draw multiplies the tangential coefficient, the radial ratio and each mode's frequency, damping and gain by
exp(s z), z normal and s their standard deviation as a share; a mode that stands in two directions moves in both. The
band holds, at each speed, the middle 95 of 100 limits. It is a forecast of the next cut with this tool, not the error
of the computation. Compare Hajdu, Insperger, Bachrathy and Stepan (2017) for robust limits of a measured FRF.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from models.errors import StabilityError
from models.records import FloatArray
from models.stability.milling import Cut
from models.stability.response import ModalResponse, Mode

DRAWS = 60
MIDDLE = (2.5, 97.5)
"""Percentiles of the limits that the band reaches from and to."""
SEED = 5


@dataclass(frozen=True, slots=True, kw_only=True)
class Uncertainty:
    """Standard deviations as shares of the value. Raises StabilityError when one is negative or 0.5 and more."""

    coefficients: float = 0.1
    """Of K_tc and of K_rc / K_tc: tool, wear, speed and chip thickness change them."""
    frequency: float = 0.005
    """Of natural frequencies: temperature, clamping, speed."""
    damping: float = 0.1
    gain: float = 0.05
    """Of a mode's size: calibration of hammer and sensor."""

    def __post_init__(self) -> None:
        """Refuse what is no share."""
        for name in self.__slots__:
            if not 0.0 <= getattr(self, name) < 0.5:
                raise StabilityError(f"an uncertainty is a share from 0 to 0.5, but {name} is {getattr(self, name):g}")


def depth_band(
    limits: Callable[[ModalResponse, Cut], FloatArray],
    response: ModalResponse,
    cut: Cut,
    uncertainty: Uncertainty,
    draws: int = DRAWS,
) -> tuple[FloatArray, FloatArray]:
    """Return between which limiting depths [mm] the middle 95 of 100 draws lie, each of the shape that `limits` gives.

    Result: low and high; inf where a draw has no limit. Raises what `limits` raises.

    `limits`: gives the limiting depths [mm] of a structure and a cut at always the same speeds; inf: none. `response`,
    `cut`: what is expected. `uncertainty`: how far it may be off. `draws`: how many structures and cuts are tried; the
    same every time, so that two charts can be compared.
    """
    random = np.random.default_rng(SEED)
    found = np.array([limits(*_drawn(response, cut, uncertainty, random)) for _ in range(draws)])
    # A limit that was found, on the outer side: between a limit and none there is no middle.
    low = np.percentile(found, MIDDLE[0], axis=0, method="lower")
    high = np.percentile(found, MIDDLE[1], axis=0, method="higher")
    return np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)


def _drawn(
    response: ModalResponse, cut: Cut, uncertainty: Uncertainty, random: np.random.Generator
) -> tuple[ModalResponse, Cut]:
    shares = [uncertainty.frequency, uncertainty.damping, uncertainty.gain]
    factors = {
        key: np.exp(np.multiply(shares, random.standard_normal(3)))
        for key in dict.fromkeys((mode.frequency_hz, mode.damping_ratio) for mode in response.modes())
    }
    tangential, ratio = np.exp(uncertainty.coefficients * random.standard_normal(2))
    entries = {
        name: tuple(_moved(mode, factors[mode.frequency_hz, mode.damping_ratio]) for mode in getattr(response, name))
        for name in ("xx", "yy", "xy", "yx")
    }
    moved = replace(
        cut, tangential_n_per_m2=cut.tangential_n_per_m2 * tangential, radial_ratio=cut.radial_ratio * ratio
    )
    return ModalResponse(**entries), moved


def _moved(mode: Mode, factors: FloatArray) -> Mode:
    frequency, damping, gain = (float(factor) for factor in factors)
    # A stiffness that was measured stays when the frequency moves: b0 = w^2 / k.
    return Mode(
        frequency_hz=mode.frequency_hz * frequency,
        damping_ratio=min(mode.damping_ratio * damping, 0.999),
        displacement_gain_per_kg=mode.displacement_gain_per_kg * gain * frequency**2,
        velocity_gain_s_per_kg=mode.velocity_gain_s_per_kg * gain * frequency,
    )
