"""A milling case for stability lobes: tool, engagement, cutting coefficients, structure (YAML)."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Discriminator, Field, Tag

from config.loader import load_yaml_model, with_absolute_paths
from config.schema.base import Problems, Section, checked
from models.errors import StabilityError
from models.stability.cutting_coefficients import MATERIALS
from models.stability.milling import Cut, MillingMode, engagement_rad

ALL_DIRECTIONS = "all"
SMALLEST_RESIDUE, LARGEST_RESIDUE = 1e-18, 1e6
"""Range of the size of a residue [m/(N s)], as wide as that of masses and frequencies."""
TURN_DEG, TURN_OFF_DEG = 360.0, 0.1
"""What pitches add up to, and how far rounding may take them off it."""


class ModeCase(Section):
    """One mode: frequency, damping, and one of mass, stiffness and residue."""

    frequency_hz: float = Field(ge=0.1, le=1e6, description="undamped natural frequency [Hz]")
    damping_ratio: float = Field(ge=1e-6, lt=1, description="share of critical damping")
    mass_kg: float | None = Field(None, ge=1e-9, le=1e9, description="modal mass [kg]")
    stiffness_n_per_m: float | None = Field(None, ge=1e-3, le=1e15, description="modal stiffness [N/m]")
    residue: list[float] | None = Field(
        None,
        min_length=2,
        max_length=2,
        description="[re, im] of r in H(s) = sum of r/(s-p) + conjugate, p = -zeta w + j w sqrt(1-zeta^2) [m/(N s)]",
    )

    @checked
    def _one_size(self) -> Problems:
        given = [name for name in ("mass_kg", "stiffness_n_per_m", "residue") if getattr(self, name) is not None]
        if len(given) != 1:
            found = " and ".join(given) or "none"
            yield (), f"give one of mass_kg, stiffness_n_per_m and residue, not {found}"
        elif self.residue is not None and not any(self.residue):
            yield ("residue",), "a residue of [0, 0] is no mode; remove the mode"
        size = 0.0 if self.residue is None else math.hypot(*self.residue)
        if self.residue is not None and not SMALLEST_RESIDUE <= size <= LARGEST_RESIDUE:
            sentence = f"{size:g} m/(N s) is no residue of a machine; it is 1 over (2 mass angular frequency)"
            yield ("residue",), sentence


class DirectionCase(Section):
    """What the tool point does in one direction: modes, a file with an FRF, or a spindle that is computed."""

    shipped: ClassVar[Mapping[str, str]] = {"spindle": "machine/data/spindles"}

    modes: list[ModeCase] | None = Field(None, min_length=1, description="the modes of this direction")
    frf: Path | None = Field(
        None, description="CSV file with frequency_hz,receptance_re,receptance_im [m/N]; relative to this file's folder"
    )
    spindle: Path | None = Field(
        None,
        description="spindle file with holder and tool, or the name of one that ships; its computed response, with "
        "gyroscopic moments at each speed; in x and y",
    )
    trust_units: bool = Field(
        False, description="take the units of frf as stated, although no tool point seems to have such a response"
    )

    @checked
    def _one_form(self) -> Problems:
        if sum(given is not None for given in (self.modes, self.frf, self.spindle)) != 1:
            yield (), "give one of modes, frf and spindle; a direction that does not move is `rigid`"
        elif self.trust_units and self.frf is None:
            yield ("trust_units",), "belongs to frf; modes have no units to trust"


def _form(value: Any) -> str:
    return "rigid" if isinstance(value, str) else "direction"


Direction = Annotated[
    Annotated[Literal["rigid"], Tag("rigid")] | Annotated[DirectionCase, Tag("direction")], Discriminator(_form)
]


def _feed_form(value: Any) -> str:
    return "all" if isinstance(value, str) else "angle"


Feed = Annotated[
    Annotated[Literal["all"], Tag("all")] | Annotated[float, Field(ge=-3600, le=3600), Tag("angle")],
    Discriminator(_feed_form),
]


class UncertaintyCase(Section):
    """How far the numbers of a case may be off, as standard deviations in shares of the value."""

    coefficients: float = Field(0.1, ge=0, lt=0.5, description="of K_tc and of K_rc / K_tc: tool, wear, speed")
    frequency: float = Field(0.005, ge=0, lt=0.5, description="of natural frequencies: temperature, clamping")
    damping: float = Field(0.1, ge=0, lt=0.5, description="of damping ratios")
    gain: float = Field(0.05, ge=0, lt=0.5, description="of a mode's size: calibration of hammer and sensor")


class StabilityCase(Section):
    """Tool, engagement, cutting coefficients and structure of one milling operation."""

    teeth: int = Field(ge=1, le=100, description="number of teeth, evenly pitched unless pitch_deg says otherwise")
    pitch_deg: list[float] | None = Field(
        None,
        min_length=1,
        description="angle from each tooth to the one that cuts after it, one for each tooth, 360 in all [deg]; not "
        "with the zeroth-order solution",
    )
    helix_deg: float = Field(
        0.0, ge=0, le=75, description="helix angle of the edges; not with the zeroth-order solution [deg]"
    )
    diameter_mm: float = Field(ge=1e-3, le=1e4, description="diameter of the tool [mm]")
    radial_depth_mm: float | None = Field(
        None, gt=0, description="radial depth of cut a_e [mm]; the diameter where milling is slot"
    )
    milling: Literal["up", "down", "slot"] = Field(description="up: against the feed; down: climb milling; slot")
    kt_n_per_m2: float | None = Field(
        None, ge=1e4, le=1e13, description="tangential cutting coefficient K_tc [N/m^2]; 1 N/mm^2 is 1e6 N/m^2"
    )
    kr_ratio: float | None = Field(None, ge=0, le=100, description="radial over tangential coefficient K_rc / K_tc")
    material: str | None = Field(None, description="a material with known coefficients, instead of the two above")
    x: Direction = Field(description="tool point in the machine's X: modes, frf, spindle, or rigid")
    y: Direction = Field(description="tool point in the machine's Y: modes, frf, spindle, or rigid")
    xy: Direction = Field("rigid", description="displacement in X per force in Y; rigid: none")
    yx: Direction = Field("rigid", description="displacement in Y per force in X; rigid: none")
    feed_deg: Feed = Field(
        0.0, description="direction of the feed against X [deg], or all: at each speed the worst of all directions"
    )
    process_damping_n_per_m: float = Field(
        0.0,
        ge=0,
        le=1e9,
        description="C of the flank's rubbing, force = C x width x speed along the normal / cutting speed; not with "
        "the zeroth-order solution [N/m]",
    )
    uncertainty: UncertaintyCase = Field(UncertaintyCase(), description="how far these numbers may be off (--band)")

    @checked
    def _consistent(self) -> Problems:
        if self.milling != "slot" and self.radial_depth_mm is None:
            yield ("milling",), "up- and down-milling need radial_depth_mm"
        else:
            try:
                engagement_rad(MillingMode(self.milling), self.radial_depth_mm or self.diameter_mm, self.diameter_mm)
            except StabilityError as error:
                yield ("radial_depth_mm",), str(error)
        yield from self._pitch_problems()
        by_name = self.material is not None
        by_value = (self.kt_n_per_m2 is not None, self.kr_ratio is not None)
        if by_name and any(by_value):
            yield ("material",), "give the material or kt_n_per_m2 and kr_ratio, not both"
        elif not by_name and not all(by_value):
            yield (), "give kt_n_per_m2 and kr_ratio, or a material that is known"
        elif by_name and self.material not in MATERIALS:
            yield ("material",), f"{self.material!r} is not known; known are {', '.join(MATERIALS)}"
        if self.x == "rigid" and self.y == "rigid":
            yield ("x",), "x and y are both rigid, so nothing can chatter; give modes or frf for one"
        yield from self._spindle_problems()

    def _spindle_problems(self) -> Problems:
        named = [
            name
            for name in ("x", "y", "xy", "yx")
            if isinstance(each := getattr(self, name), DirectionCase) and each.spindle is not None
        ]
        if named and not (named == ["x", "y"] and self.xy == self.yx == "rigid"):
            sentence = (
                "a spindle is computed in both axes: give x and y a spindle, the same file where they are alike, and "
                "leave xy and yx out"
            )
            yield (named[0], "spindle"), sentence

    @property
    def rotating(self) -> bool:
        """Whether the dynamics are those of a spindle that is computed at each speed."""
        return isinstance(self.x, DirectionCase) and self.x.spindle is not None

    def _pitch_problems(self) -> Problems:
        if self.pitch_deg is None:
            return
        if len(self.pitch_deg) != self.teeth:
            words = f"{len(self.pitch_deg)} pitches for {self.teeth} teeth; give one angle for each tooth"
            yield ("pitch_deg",), words
        elif not all(0.0 < pitch < math.inf for pitch in self.pitch_deg):
            yield ("pitch_deg",), "every pitch is an angle above 0 deg"
        elif abs(sum(self.pitch_deg) - TURN_DEG) > TURN_OFF_DEG:
            yield ("pitch_deg",), f"the pitches add up to {sum(self.pitch_deg):g} deg; they make a turn of 360 deg"

    def cut(self) -> Cut:
        start_rad, exit_rad = engagement_rad(
            MillingMode(self.milling), self.radial_depth_mm or self.diameter_mm, self.diameter_mm
        )
        pitches = self.pitch_deg or []
        if self.material is not None:
            known = MATERIALS[self.material]
            tangential, ratio = known.tangential_n_per_m2, known.radial_ratio
        else:
            assert self.kt_n_per_m2 is not None
            assert self.kr_ratio is not None
            tangential, ratio = self.kt_n_per_m2, self.kr_ratio
        return Cut(
            teeth=self.teeth,
            start_rad=start_rad,
            exit_rad=exit_rad,
            tangential_n_per_m2=tangential,
            radial_ratio=ratio,
            diameter_m=self.diameter_mm * 1e-3,
            helix_rad=math.radians(self.helix_deg),
            pitch_rad=tuple(2.0 * math.pi * pitch / sum(pitches) for pitch in pitches),
            process_damping_n_per_m=self.process_damping_n_per_m,
        )


def load_stability_case(path: Path) -> StabilityCase:
    """Read a case; relative paths in it start at the file's own folder. Raises ConfigurationError."""
    return with_absolute_paths(load_yaml_model(path, StabilityCase), path.resolve().parent)


__all__ = ["ALL_DIRECTIONS", "DirectionCase", "ModeCase", "StabilityCase", "UncertaintyCase", "load_stability_case"]
