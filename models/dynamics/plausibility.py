"""What a measured response cannot be: limits that follow from metal, and other readings of its numbers.

The unit of a response does not stand in its numbers. Three things betray a wrong one: a frequency axis on which no
spindle is measured; a mass that moves with the point and is smaller than any beam's end has; and a level that a
known shaft cannot give, whatever its bearings.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from models.dynamics.beam import ComplexArray
from models.dynamics.measurement import Measurement, MeasurementError
from models.records import FloatArray

LOWEST_LAST_HZ = 50.0
"""A measurement that ends below this holds no spindle's resonance; an analyser's range in kHz does end there."""
HIGHEST_LAST_HZ = 50_000.0
"""No hammer excites beyond this; 12.8 kHz read in rad/s does end there."""

DENSITY_KG_PER_M3 = 7850.0
SOUND_M_PER_S = 5100.0
"""Square root of E / rho, much the same for steel, aluminium and titanium."""
STIFFEST_PA = 6e11
"""Young's modulus of cemented carbide."""
LARGEST_SHANK_M = 0.02
"""A larger cutter may sit on a neck of this diameter."""
MASS_MARGIN = 10.0
"""The mass of a point may be this many times smaller than a straight steel shank's end (necks, light metal)."""

STANDARD_GRAVITY_M_PER_S2 = 9.80665
LEVEL_MARGIN = 10.0
"""The level of a response may lie this many times outside what the shaft gives."""


def check_frequencies(frequency_hz: FloatArray) -> None:
    """Refuse an axis, shape (n,), that is not in Hz; raises MeasurementError."""
    last = float(frequency_hz[-1])
    if last < LOWEST_LAST_HZ:
        raise MeasurementError(
            f"the frequencies end at {last:g} Hz, below every resonance of a spindle (above {LOWEST_LAST_HZ:g} Hz); "
            f"is the axis in kHz? Multiply it by 1000"
        )
    if last > HIGHEST_LAST_HZ:
        raise MeasurementError(
            f"the frequencies end at {last:g} Hz, where no hammer excites a spindle (up to {HIGHEST_LAST_HZ:g} Hz); "
            "is the axis in rad/s or 1/min? Divide it by 2 pi or by 60"
        )


def moving_mass_kg(measured: Measurement) -> float:
    """Return the mass that moves with a point that is hit and measured at once [kg].

    Of modes with the masses m_i at the point it is 1 / sum(1 / m_i), for -Im H of a mode, times omega, integrates to
    pi / (2 m_i). Negative or infinite where the imaginary part is not negative on balance.
    """
    omega = 2.0 * np.pi * measured.frequency_hz
    total = float(np.trapezoid(-measured.receptance_m_per_n.imag * omega, omega))
    return 0.5 * np.pi / total if total != 0.0 else np.inf


def least_mass_kg(diameter_m: float, highest_hz: float) -> float:
    """Return the mass that the end of a long steel cylinder shows up to a frequency [kg].

    An eighth of the mass of one bending wave: each mode of a beam of length L has a quarter of its mass at the
    end, and k L / pi modes lie below the frequency whose wave number is k.
    """
    area = 0.25 * np.pi * diameter_m**2
    wave_number = np.sqrt(2.0 * np.pi * highest_hz / (0.25 * diameter_m * SOUND_M_PER_S))
    return float(DENSITY_KG_PER_M3 * area * 0.25 * np.pi / wave_number)


def check_tool_point(measured: Measurement, diameter_m: float) -> None:
    """Refuse what the tip of a tool of this diameter [m], hit and measured at once, cannot show.

    Raises MeasurementError when the axis is not in Hz, the sign is that of no passive structure, the moving mass is
    smaller than that of a shank, or the tip is stiffer than a carbide cylinder as short as thick.
    """
    frequency_hz, size = measured.frequency_hz, np.abs(measured.receptance_m_per_n)
    check_frequencies(frequency_hz)
    highest = int(np.argmax(size))
    mass = moving_mass_kg(measured)
    if mass <= 0.0:
        raise MeasurementError(
            f"the imaginary part is positive on balance (at the highest peak, {frequency_hz[highest]:g} Hz, it is "
            f"{measured.receptance_m_per_n[highest].imag:g}), which no point shows that is hit and measured at once; "
            "turn the phase by 180 degrees, or take the complex conjugate"
        )
    shank_m = min(diameter_m, LARGEST_SHANK_M)
    least = least_mass_kg(shank_m, float(frequency_hz[-1])) / MASS_MARGIN
    if mass < least:
        raise MeasurementError(
            f"read in m/N, a mass of {mass * 1e3:.2g} g moves with the tool point (peak of {size[highest]:.3g} at "
            f"{frequency_hz[highest]:g} Hz), less than the end of a {shank_m * 1e3:g} mm shank can have "
            f"({least * 1e3:.2g} g up to {frequency_hz[-1]:g} Hz); is the unit mm/N or um/N, is this a mobility or an "
            "accelerance, or is the axis in rad/s?"
        )
    stiffest = 1.0 / (STIFFEST_PA * diameter_m)
    if size[highest] < stiffest:
        raise MeasurementError(
            f"the largest receptance, {size[highest]:.3g} m/N at {frequency_hz[highest]:g} Hz, is that of a point "
            f"stiffer than a carbide cylinder of {diameter_m * 1e3:g} mm ({stiffest:.3g} m/N); is the unit another?"
        )


def level_m_per_n(receptance: ComplexArray) -> float:
    """Return the geometric mean of the magnitudes of a receptance [m/N], shape (n,)."""
    return float(np.exp(np.mean(np.log(np.abs(receptance)))))


def check_level(measured: Measurement, lowest_m_per_n: float, highest_m_per_n: float) -> None:
    """Refuse a response whose level lies far outside what a known structure gives [m/N]; raises MeasurementError."""
    level = level_m_per_n(measured.receptance_m_per_n)
    if lowest_m_per_n / LEVEL_MARGIN <= level <= highest_m_per_n * LEVEL_MARGIN:
        return
    others = [
        what
        for what, other in other_readings(measured)
        if np.array_equal(other.frequency_hz, measured.frequency_hz)
        and lowest_m_per_n <= level_m_per_n(other.receptance_m_per_n) <= highest_m_per_n
    ]
    band = f"{measured.frequency_hz[0]:g} to {measured.frequency_hz[-1]:g} Hz"
    hint = f"; it would be with numbers {' or '.join(others)}" if others else "; is the axis in rad/s or kHz?"
    raise MeasurementError(
        f"the receptances from {band} are {level:.3g} m/N in the geometric mean; the structure of the file gives "
        f"{lowest_m_per_n:.2g} to {highest_m_per_n:.2g} m/N on any usual bearings{hint}. "
        "Convert the response to m/N over Hz, or name its columns after what they hold"
    )


def other_readings(measured: Measurement) -> Iterator[tuple[str, Measurement]]:
    """Yield what the numbers mean when they are in another unit or of another quantity, as a receptance over Hz."""
    j_omega = np.asarray(2j * np.pi * measured.frequency_hz, dtype=np.complex128)
    values: dict[str, Any] = {
        "in mm/N": 1e-3,
        "in um/N": 1e-6,
        "of an accelerance in m/s^2 per N": 1.0 / j_omega**2,
        "of a mobility in m/s per N": 1.0 / j_omega,
        "of an accelerance in g per N": STANDARD_GRAVITY_M_PER_S2 / j_omega**2,
        "of a mobility in mm/s per N": 1e-3 / j_omega,
        "in m/kN": 1e3,
    }
    changes: dict[str, dict[str, Any]] = {
        what: {"receptance_m_per_n": measured.receptance_m_per_n * factor} for what, factor in values.items()
    }
    for what, scale in {"over kHz": 1e3, "over rad/s": 0.5 / np.pi, "over 1/min": 1.0 / 60.0}.items():
        changes[what] = {"frequency_hz": measured.frequency_hz * scale}
    for what, change in changes.items():
        try:
            other = replace(measured, **change)
        except MeasurementError:
            continue  # Nothing is measured that small or large, so this is not what the numbers mean.
        yield what, other
