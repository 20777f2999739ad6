"""The structure at the tool point: receptance from modes or from samples.

Modes: ``H(s) = sum of r/(s - p) + conjugate`` with ``p = -zeta w + j w sqrt(1 - zeta^2)``; each term is
kept as the real fraction ``(b0 + b1 s) / (s^2 + 2 zeta w s + w^2)``, which also holds two real poles.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from models.errors import StabilityError
from models.records import FloatArray

ComplexArray = npt.NDArray[np.complex128]

FINEST_STEPS = 800
"""Frequencies laid around each mode by `ModalResponse.frequencies_hz`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Mode:
    """One term of a receptance: ``(b0 + b1 s) / (s^2 + 2 zeta w s + w^2)``."""

    frequency_hz: float
    """Undamped natural frequency w / 2 pi [Hz]."""
    damping_ratio: float
    displacement_gain_per_kg: float
    """b0 [1/kg]: 1/m of a mode that is real."""
    velocity_gain_s_per_kg: float = 0.0
    """b1 [s/kg]: 0 of a mode that is real."""

    def __post_init__(self) -> None:
        """Refuse what cannot vibrate and die away, or has no finite size. Raises StabilityError."""
        if not (self.frequency_hz > 0.0 and self.damping_ratio > 0.0):
            raise StabilityError(
                f"a mode at {self.frequency_hz:g} Hz with damping ratio {self.damping_ratio:g} does not die away; "
                "both must be above 0"
            )
        if not math.isfinite(self.displacement_gain_per_kg + self.velocity_gain_s_per_kg):
            raise StabilityError(f"a mode at {self.frequency_hz:g} Hz has no finite size; correct its stiffness or fit")

    @property
    def angular_rad_s(self) -> float:
        """Undamped natural frequency [rad/s]."""
        return 2.0 * math.pi * self.frequency_hz


def mode_from_mass(frequency_hz: float, damping_ratio: float, mass_kg: float) -> Mode:
    """Return a real mode of a modal mass [kg]. Raises StabilityError."""
    return Mode(frequency_hz=frequency_hz, damping_ratio=damping_ratio, displacement_gain_per_kg=1.0 / mass_kg)


def mode_from_stiffness(frequency_hz: float, damping_ratio: float, stiffness_n_per_m: float) -> Mode:
    """Return a real mode of a modal stiffness [N/m]. Raises StabilityError."""
    return mode_from_mass(frequency_hz, damping_ratio, stiffness_n_per_m / (2.0 * math.pi * frequency_hz) ** 2)


def mode_from_residue(frequency_hz: float, damping_ratio: float, residue: complex) -> Mode:
    """Return a mode of a residue r [m/(N s)] at the pole with positive imaginary part. Raises StabilityError."""
    if not 0.0 < damping_ratio < 1.0:
        raise StabilityError(f"a residue needs a damping ratio between 0 and 1, not {damping_ratio:g}")
    angular = 2.0 * math.pi * frequency_hz
    pole = complex(-damping_ratio * angular, angular * math.sqrt(1.0 - damping_ratio**2))
    return Mode(
        frequency_hz=frequency_hz,
        damping_ratio=damping_ratio,
        displacement_gain_per_kg=-2.0 * (residue * pole.conjugate()).real,
        velocity_gain_s_per_kg=2.0 * residue.real,
    )


def modal_receptance(modes: Sequence[Mode], frequency_hz: FloatArray) -> ComplexArray:
    """Return the receptance of a sum of modes [m/N], shape of `frequency_hz` [Hz]."""
    laplace = 2j * math.pi * np.asarray(frequency_hz)
    total = np.zeros(laplace.shape, dtype=np.complex128)
    for mode in modes:
        angular = mode.angular_rad_s
        denominator = laplace**2 + 2.0 * mode.damping_ratio * angular * laplace + angular**2
        total += (mode.displacement_gain_per_kg + mode.velocity_gain_s_per_kg * laplace) / denominator
    return total


def check_finite(frequency_hz: FloatArray, receptance: ComplexArray) -> None:
    """Refuse an FRF with a value that is not finite, which lobes would take for stable to any depth.

    Raises StabilityError, which names the first such frequency.

    `frequency_hz`: shape (n,) [Hz]. `receptance`: first axis of length n [m/N].
    """
    finite = np.isfinite(receptance).reshape(len(frequency_hz), -1).all(axis=1) & np.isfinite(frequency_hz)
    if not finite.all():
        raise StabilityError(
            f"the FRF holds no finite value at {frequency_hz[int(np.argmin(finite))]:g} Hz; measure it again"
        )


class ToolPointResponse(Protocol):
    """Receptance at the tool point as a function of frequency, in machine axes."""

    def receptance_m_per_n(self, frequency_hz: FloatArray) -> ComplexArray:
        """Return the receptance matrix [m/N], shape (n, 2, 2): displacement X, Y per force X, Y."""

    def frequencies_hz(self, highest_tooth_passing_hz: float) -> FloatArray:
        """Return ascending frequencies [Hz] dense enough to show every resonance."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ModalResponse:
    """Modes per direction; an empty tuple is rigid."""

    xx: tuple[Mode, ...] = ()
    yy: tuple[Mode, ...] = ()
    xy: tuple[Mode, ...] = ()
    """Displacement in X per force in Y."""
    yx: tuple[Mode, ...] = ()

    def entries(self) -> tuple[tuple[int, int, tuple[Mode, ...]], ...]:
        """Return displacement axis, force axis and modes of the four entries."""
        return (0, 0, self.xx), (0, 1, self.xy), (1, 0, self.yx), (1, 1, self.yy)

    def modes(self) -> tuple[Mode, ...]:
        """Return every mode."""
        return (*self.xx, *self.yy, *self.xy, *self.yx)

    def receptance_m_per_n(self, frequency_hz: FloatArray) -> ComplexArray:
        """Return the receptance matrix [m/N], shape (n, 2, 2)."""
        matrix = np.zeros((len(frequency_hz), 2, 2), dtype=np.complex128)
        for displacement, force, modes in self.entries():
            matrix[:, displacement, force] = modal_receptance(modes, frequency_hz)
        return matrix

    def frequencies_hz(self, highest_tooth_passing_hz: float) -> FloatArray:
        """Return frequencies, dense around each mode, to beyond every lobe that can matter [Hz]."""
        modes = self.modes()
        if not modes:
            raise StabilityError("both directions are rigid, so no cut can chatter; give modes or an FRF for one")
        top = 2.0 * max(mode.frequency_hz for mode in modes) + 2.0 * highest_tooth_passing_hz
        steps = np.sinh(np.linspace(-7.0, 7.0, FINEST_STEPS)) / math.sinh(7.0)
        near = [mode.frequency_hz * (1.0 + 120.0 * min(mode.damping_ratio, 0.2) * steps) for mode in modes]
        bottom = 0.01 * min(mode.frequency_hz for mode in modes)
        everything = np.concatenate([*near, np.linspace(bottom, top, 1500)])
        return np.unique(everything[(everything >= bottom) & (everything <= top)])


@dataclass(frozen=True, slots=True, kw_only=True)
class SampledResponse:
    """A measured or modelled FRF at ascending frequencies."""

    frequency_hz: FloatArray
    """Shape (n,), ascending [Hz]."""
    receptance: ComplexArray
    """Shape (n, 2, 2) [m/N]."""

    def __post_init__(self) -> None:
        """Check shapes and order. Raises StabilityError."""
        if len(self.frequency_hz) < 4 or self.receptance.shape != (len(self.frequency_hz), 2, 2):
            raise StabilityError("an FRF needs at least 4 frequencies and a 2 x 2 matrix for each")
        if not bool(np.all(np.diff(self.frequency_hz) > 0.0)):
            raise StabilityError("the frequencies of an FRF must ascend; sort its rows")

    def frequencies_hz(self, highest_tooth_passing_hz: float) -> FloatArray:
        """Return the sampled frequencies [Hz]; `highest_tooth_passing_hz` changes nothing."""
        return self.frequency_hz

    def receptance_m_per_n(self, frequency_hz: FloatArray) -> ComplexArray:
        """Return the receptance between the samples [m/N], shape (n, 2, 2).

        Cubic through the four nearest samples, of the receptance or of its inverse, whichever is
        smoother there: near a resonance the inverse is nearly a parabola. Exact at the samples.

        Raises StabilityError for a frequency outside the samples.
        """
        low, high = self.frequency_hz[0], self.frequency_hz[-1]
        if np.any((frequency_hz < low) | (frequency_hz > high)):
            raise StabilityError(f"the FRF covers {low:g} to {high:g} Hz only; measure or model a wider band")
        if frequency_hz is self.frequency_hz:
            return self.receptance
        first = np.clip(np.searchsorted(self.frequency_hz, frequency_hz) - 2, 0, len(self.frequency_hz) - 4)
        stencil = first[:, None] + np.arange(4)
        weights = _lagrange_weights(self.frequency_hz[stencil], frequency_hz)[:, :, None, None]
        samples = self.receptance[stencil]
        smallest = float(np.abs(samples).max(initial=0.0)) * 1e-12 + 1e-300
        inverses = 1.0 / np.where(np.abs(samples) < smallest, smallest, samples)
        direct, inverse = np.sum(weights * samples, axis=1), np.sum(weights * inverses, axis=1)
        smoother = (_roughness(inverses.astype(np.complex128)) < _roughness(samples)) & (
            np.abs(samples).min(axis=1) > smallest
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            matrix: ComplexArray = np.where(smoother, 1.0 / inverse, direct)
        return matrix


def _lagrange_weights(nodes: FloatArray, at: FloatArray) -> FloatArray:
    """Return the weights of four nodes per row, shape (n, 4)."""
    weights = np.ones(nodes.shape)
    for own in range(4):
        for other in range(4):
            if other != own:
                weights[:, own] *= (at - nodes[:, other]) / (nodes[:, own] - nodes[:, other])
    return weights


def _roughness(samples: ComplexArray) -> FloatArray:
    """Return the third difference of four samples against their size, shape (n, 2, 2)."""
    third = samples[:, 3] - 3.0 * samples[:, 2] + 3.0 * samples[:, 1] - samples[:, 0]
    ratio: FloatArray = np.abs(third) / (np.abs(samples).min(axis=1) + 1e-300)
    return ratio


def feed_rotation(feed_deg: float) -> FloatArray:
    """Return the matrix, shape (2, 2), that gives feed and normal components of an X, Y vector."""
    angle = math.radians(feed_deg)
    return np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
