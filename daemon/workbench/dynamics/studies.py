"""Sensitivity of a shaft to its elastic moduli, and comparison of layouts, as plain data."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from config.machine.spindle import (
    Constants,
    MaterialDescription,
    SegmentDescription,
    SpindleDescription,
    shipped_materials,
)
from config.machine.spindle_chain import Spindle, build_spindle, segment_elasticity
from daemon.workbench.dynamics.responses import ResponseError, peaks, response, spindle_modes
from models.dynamics.modes import mode_changes
from models.records import FloatArray

ISOTROPY = 0.01
"""How far G may lie beside E / (2 (1 + nu)) of a tube that counts as isotropic metal."""
WIDE_HZ = np.geomspace(10.0, 10_000.0, 4000)
"""Where the highest resonance is looked for beside the band [Hz]."""
VARIED = (("E",), ("G",), ("E", "G"))


def sensitivity_summary(spindle: Spindle, file: Path, percent: float, count: int) -> dict[str, Any]:
    """Return what `toolpoint dynamics sensitivity` prints: modes with moduli that are off by a percentage.

    Composites vary; without any, everything does. A constant that overrides a mixture changes by as much as the
    mixture.
    """
    told = spindle.description
    names = _varied_materials(told)
    numbers = _varied_segments(told, names)
    everything = not names and not numbers
    base = spindle_modes(spindle, count)
    variations = []
    for moduli in VARIED:
        for sign in (1.0, -1.0):
            factor = 1.0 + sign * percent / 100.0
            changed = _scaled(told, file, moduli, factor, None if everything else names)
            modes = spindle_modes(build_spindle(changed, file, spindle.rotary), count)
            variations.append(
                {
                    "moduli": "+".join(moduli),
                    "percent": sign * percent,
                    "modes": [asdict(change) for change in mode_changes(base, modes)],
                }
            )
    return {
        "name": told.name,
        "rigid_rotary_inertia": spindle.rotary,
        "warnings": list(spindle.warnings),
        "percent": percent,
        "varied_materials": "all" if everything else names,
        "varied_segments": list(range(1, len(told.segments) + 1)) if everything else numbers,
        "baseline": [{"frequency_hz": mode.frequency_hz} for mode in base],
        "variations": variations,
    }


def _varied_materials(told: SpindleDescription) -> list[str]:
    materials = {**shipped_materials(), **told.materials}
    used = set()
    for segment in told.segments:
        used |= set(segment.mixture or ()) | {layer.material for layer in segment.layers or ()}
        used |= {each.material for each in (segment, segment.ring, segment.core) if each and each.material}
    return sorted(name for name in used if materials[name].G_gpa is None)


def _varied_segments(told: SpindleDescription, names: Sequence[str]) -> list[int]:
    numbers = []
    for number, segment in enumerate(told.segments, start=1):
        used = set(segment.mixture or ()) | {layer.material for layer in segment.layers or ()} | {segment.material}
        if used & set(names) or any(_written_composite(each) for each in (segment, segment.ring, segment.core)):
            numbers.append(number)
    return numbers


def _written_composite(told: Constants | None) -> bool:
    """Return whether constants are written out that no isotropic material has."""
    if told is None or told.E_gpa is None or told.G_gpa is None or told.nu is None or told.material is not None:
        return False
    return abs(told.G_gpa * 2.0 * (1.0 + told.nu) / told.E_gpa - 1.0) > ISOTROPY


def _scaled(
    told: SpindleDescription, file: Path, moduli: tuple[str, ...], factor: float, names: list[str] | None
) -> SpindleDescription:
    """Return the description with the moduli of the named materials (None: of everything) multiplied."""
    materials = {**shipped_materials(), **told.materials}
    changed = {
        name: _scaled_material(each, moduli, factor) if names is None or name in names else each
        for name, each in materials.items()
    }
    described = told.model_copy(update={"materials": changed})
    segments = [
        _scaled_segment(segment, (told, described), file, moduli, factor, names is None) for segment in told.segments
    ]
    return described.model_copy(update={"segments": segments})


def _scaled_material(told: MaterialDescription, moduli: tuple[str, ...], factor: float) -> MaterialDescription:
    update = {"E_gpa": told.E_gpa * factor} if "E" in moduli else {}
    if "G" in moduli:
        for name in ("G_gpa", "G_zx_gpa", "G_zy_gpa"):
            value = getattr(told, name)
            if value is not None:
                update[name] = value * factor
    return told.model_copy(update=update)


def _scaled_segment(
    told: SegmentDescription,
    described: tuple[SpindleDescription, SpindleDescription],
    file: Path,
    moduli: tuple[str, ...],
    factor: float,
    everything: bool,
) -> SegmentDescription:
    update: dict[str, Any] = {}
    for name in ("ring", "core"):
        tube = getattr(told, name)
        if tube is not None and tube.material is None and (everything or _written_composite(tube)):
            update[name] = tube.model_copy(update=_multiplied(tube, moduli, factor, factor))
    if told.mixture is not None or told.layers is not None or told.material is not None:
        before, after = (segment_elasticity(each, _bare(told), file) for each in described)
        ratios = after.young_pa / before.young_pa, after.shear_pa / before.shear_pa
        update.update(_multiplied(told, ("E", "G"), *ratios))
    elif everything or _written_composite(told):
        update.update(_multiplied(told, moduli, factor, factor))
    return told.model_copy(update=update)


def _bare(told: SegmentDescription) -> SegmentDescription:
    return told.model_copy(update={"E_gpa": None, "G_gpa": None})


def _multiplied(told: Constants, moduli: tuple[str, ...], young: float, shear: float) -> dict[str, float]:
    update = {}
    if "E" in moduli and told.E_gpa is not None:
        update["E_gpa"] = told.E_gpa * young
    if "G" in moduli and told.G_gpa is not None:
        update["G_gpa"] = told.G_gpa * shear
    return update


def _size(peak: dict[str, float]) -> float:
    return peak["magnitude_m_per_n"]


def comparison_summary(spindles: Sequence[tuple[str, Spindle]], at: str, frequency_hz: FloatArray) -> dict[str, Any]:
    """Return what `toolpoint dynamics compare` prints: the highest peak of each layout, beside the first's."""
    layouts: list[dict[str, Any]] = []
    beside: list[str] = []
    for file, spindle in spindles:
        try:
            receptance = response(spindle, at, frequency_hz)
        except ResponseError as error:
            raise ResponseError(f"{file}: {error}") from error
        highest = int(np.argmax(np.abs(receptance)))
        wide = peaks(WIDE_HZ, response(spindle, at, WIDE_HZ))
        outside = [each for each in wide if not frequency_hz[0] <= each["frequency_hz"] <= frequency_hz[-1]]
        if outside and _size(most := max(outside, key=_size)) > abs(receptance[highest]):
            beside.append(
                f"{file}: the highest resonance lies at {most['frequency_hz']:.0f} Hz, outside {frequency_hz[0]:g} to "
                f"{frequency_hz[-1]:g} Hz, with {_size(most):.3g} m/N or more: what stands here is not the highest; "
                "change --from-hz or --to-hz"
            )
        elif highest in (0, len(frequency_hz) - 1):
            beside.append(
                f"{file}: the receptance is largest at {frequency_hz[highest]:g} Hz, an end of the band, which is no "
                "resonance; change --from-hz or --to-hz"
            )
        layouts.append(
            {
                "file": file,
                "name": spindle.description.name,
                "rigid_rotary_inertia": spindle.rotary,
                "warnings": list(spindle.warnings),
                "mass_kg": spindle.assembly(at).whole().mass_kg,
                "bearings": len(spindle.shaft.supports),
                "frequency_hz": float(frequency_hz[highest]),
                "compliance_m_per_n": float(np.abs(receptance[highest])),
                "peaks": peaks(frequency_hz, receptance),
            }
        )
    first = layouts[0]["compliance_m_per_n"]
    for layout in layouts:
        layout["compliance_change_percent"] = 100.0 * (layout["compliance_m_per_n"] / first - 1.0)
    return {
        "at": at,
        "from_hz": float(frequency_hz[0]),
        "to_hz": float(frequency_hz[-1]),
        "warnings": [*(warning for layout in layouts for warning in layout["warnings"]), *beside],
        "layouts": layouts,
    }
