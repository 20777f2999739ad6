"""A spindle as data: segments, materials, rings, bearings, holder, tool, joints (YAML)."""

import json
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Literal

from pydantic import Field

from config.files import sha256_of
from config.loader import load_yaml_model
from config.schema.base import Name, Problems, Section, checked, repeated

Origin = Literal["published", "derived", "fitted", "assumed", "measured", "design"]
Rotary = Literal["correct", "published"]

LEAST_GPA, MOST_GPA = 1e-3, 2000.0
"""Range of moduli: softer is foam, stiffer than diamond is a slip of the pen."""
STIFFEST = 1e15
"""Largest stiffness or damping in SI units; a rigid tie needs no more, and more drowns the shaft in rounding."""

OWN_CONSTANTS = ("E_gpa", "G_gpa", "nu", "density_g_cm3")
RATIO_SUM = 1e-3
"""How far the volume ratios of a mixture may sum up beside 1; they are then made to."""


class MaterialDescription(Section):
    """A material: isotropic with G_gpa, or a laminate with G_zx_gpa and G_zy_gpa."""

    E_gpa: float = Field(ge=LEAST_GPA, le=MOST_GPA, description="Young's modulus along the axis [GPa]")
    G_gpa: float | None = Field(
        None, ge=LEAST_GPA, le=MOST_GPA, description="shear modulus of an isotropic material [GPa]"
    )
    G_zx_gpa: float | None = Field(
        None, ge=LEAST_GPA, le=MOST_GPA, description="shear modulus between axis and radius [GPa]"
    )
    G_zy_gpa: float | None = Field(
        None, ge=LEAST_GPA, le=MOST_GPA, description="shear modulus between axis and circumference [GPa]"
    )
    nu: float | None = Field(
        None, gt=-1, lt=1, description="Poisson's ratio; none: a section with it must give its own"
    )
    density_g_cm3: float = Field(ge=0.01, le=25, description="density [g/cm^3]")
    origin: Origin | None = Field(None, description="where the numbers come from")
    note: str | None = Field(None, description="what a reader should know about them")

    @checked
    def _one_form(self) -> Problems:
        laminate = (self.G_zx_gpa is not None, self.G_zy_gpa is not None)
        if (self.G_gpa is None) != all(laminate) or any(laminate) != all(laminate):
            yield (), "give G_gpa, or both G_zx_gpa and G_zy_gpa"


class Constants(Section):
    """Elastic constants of a tube: written out, or a material with constants that override it."""

    E_gpa: float | None = Field(None, ge=LEAST_GPA, le=MOST_GPA, description="Young's modulus [GPa]")
    G_gpa: float | None = Field(None, ge=LEAST_GPA, le=MOST_GPA, description="shear modulus [GPa]")
    nu: float | None = Field(None, gt=-1, lt=1, description="Poisson's ratio of the shear coefficient")
    density_g_cm3: float | None = Field(None, ge=0.01, le=25, description="density [g/cm^3]")
    material: str | None = Field(None, description="name of a material, shipped or under `materials`")

    def _missing(self) -> Problems:
        """Return what lacks when no material stands beside the constants."""
        lacking = [name for name in OWN_CONSTANTS if getattr(self, name) is None]
        if lacking:
            yield (), f"{' and '.join(lacking)} missing: write all of {', '.join(OWN_CONSTANTS)}, or name a material"


class _Tube(Constants):
    """A tube whose constants are complete by themselves."""

    @checked
    def _complete(self) -> Problems:
        if self.material is None:
            yield from self._missing()


class Ring(_Tube):
    """A tube shrunk onto a segment: rotor or sleeve."""

    outer_mm: float = Field(gt=0, description="outer diameter [mm]; the inner one is the segment's outer")


class Core(_Tube):
    """A tube inside a segment that bends with it: the taper of a holder."""

    inner_mm: float = Field(ge=0, description="inner diameter [mm]; the outer one is the segment's inner")


class LayerDescription(Section):
    """One layer of a section, from the bore outwards."""

    material: str = Field(description="name of a material, shipped or under `materials`")
    outer_mm: float = Field(gt=0, description="outer diameter of the layer [mm]")


class SegmentDescription(Constants):
    """A stretch of constant section."""

    length_mm: float = Field(ge=0.01, le=10_000, description="length [mm]")
    outer_mm: float = Field(ge=0.1, le=2_000, description="outer diameter [mm]")
    inner_mm: float = Field(0.0, ge=0, description="inner diameter [mm]; 0: a full section")
    mixture: dict[str, float] | None = Field(
        None, min_length=1, description="material -> volume ratio; spread uniformly over the section"
    )
    layers: list[LayerDescription] | None = Field(None, min_length=1, description="layers from the bore outwards")
    ring: Ring | None = Field(None, description="a tube shrunk onto the segment")
    core: Core | None = Field(None, description="a tube inside that bends with the segment")
    axial_load_n: float = Field(0.0, description="axial load [N], positive in compression")
    origin: Origin | None = Field(None, description="where the numbers come from")
    note: str | None = Field(None, description="what a reader should know about them")

    @checked
    def _consistent(self) -> Problems:
        if self.inner_mm >= self.outer_mm:
            yield ("inner_mm",), f"inner {self.inner_mm:g} mm must be smaller than outer_mm {self.outer_mm:g} mm"
        if self.ring and self.ring.outer_mm <= self.outer_mm:
            sentence = f"a ring sits on the segment, so it must be larger than outer_mm {self.outer_mm:g} mm"
            yield ("ring", "outer_mm"), sentence
        if self.core and self.core.inner_mm >= self.inner_mm:
            sentence = f"a core sits in the bore, so it must be smaller than inner_mm {self.inner_mm:g} mm"
            yield ("core", "inner_mm"), sentence
        yield from self._form_problems()

    def _form_problems(self) -> Problems:
        given = [name for name in ("material", "mixture", "layers") if getattr(self, name) is not None]
        if len(given) > 1:
            yield (given[1],), f"give one of {' and '.join(given)}"
            return
        if not given:
            yield from self._missing()
        if self.mixture is not None:
            for name, ratio in self.mixture.items():
                if ratio < 0.0:
                    yield ("mixture", name), f"a volume ratio is not negative, got {ratio:g}"
            if abs(sum(self.mixture.values()) - 1.0) > RATIO_SUM:
                yield ("mixture",), f"volume ratios must sum up to 1, not to {sum(self.mixture.values()):g}"
        edges = [self.inner_mm, *(layer.outer_mm for layer in self.layers or ())]
        within = [index for index, (inner, outer) in enumerate(pairwise(edges)) if outer <= inner]
        for index in within:
            yield ("layers", index, "outer_mm"), f"must be larger than what lies inside, {edges[index]:g} mm"
        if self.layers and not within and abs(edges[-1] - self.outer_mm) > 1e-6:
            sentence = f"the outermost layer ends at {edges[-1]:g} mm, but outer_mm is {self.outer_mm:g} mm"
            yield ("layers", len(self.layers) - 1, "outer_mm"), sentence


class Springs(Section):
    """Springs and dampers between two bodies."""

    kt_n_per_m: float = Field(0.0, ge=0, le=STIFFEST, description="translational stiffness [N/m]")
    ct_ns_per_m: float = Field(0.0, ge=0, le=STIFFEST, description="translational damping [N s/m]")
    kr_nm_per_rad: float = Field(0.0, ge=0, le=STIFFEST, description="rotational stiffness [N m/rad]")
    cr_nms_per_rad: float = Field(0.0, ge=0, le=STIFFEST, description="rotational damping [N m s/rad]")
    origin: Origin | None = Field(None, description="where the numbers come from")
    note: str | None = Field(None, description="what a reader should know about them")


GROUP_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9_]*$"


class BearingDescription(Springs):
    """A bearing between the shaft and the housing."""

    group: str = Field(
        pattern=GROUP_PATTERN,
        max_length=20,
        description="name of the group: its bearings share their properties; numbers in quotes",
        examples=["front"],
    )
    position_mm: float = Field(ge=0, description="distance from the nose [mm]")
    position_origin: Origin | None = Field(None, description="where the position comes from")


class JointDescription(Springs):
    """An elastic joint within the shaft."""

    after_segment: int = Field(ge=1, description="number of the segment in front of the joint, from 1")


class Body(Section):
    """Holder or tool: its segments from the front backwards and the joint at its rear end."""

    segments: list[SegmentDescription] = Field(min_length=1, description="from the front backwards")
    joint: Springs | None = Field(None, description="contact at the rear end; none: rigid")
    structural_damping: float | None = Field(
        None, ge=0, lt=0.5, description="zeta of E (1 + j zeta), G (1 + j zeta); none: the shaft's"
    )


class SpindleDescription(Section):
    """A spindle: shaft from the nose backwards, bearings, and what is clamped into it."""

    name: str | None = Field(None, description="name of the spindle, for people")
    note: str | None = Field(None, description="what a reader should know")
    structural_damping: float = Field(0.0, ge=0, lt=0.5, description="zeta of E (1 + j zeta), G (1 + j zeta)")
    rigid_rotary_inertia: Rotary | None = Field(
        None, description="correct (default), or published: as printed, to reproduce the published tables"
    )
    bearings_identified_with: Rotary | None = Field(
        None, description="rotary-inertia setting with which the bearing properties were identified"
    )
    materials: dict[Name, MaterialDescription] = Field({}, description="materials beside the shipped ones")
    segments: list[SegmentDescription] = Field(min_length=1, description="the shaft from the nose backwards")
    joints: list[JointDescription] = Field([], description="elastic joints within the shaft")
    bearings: list[BearingDescription] | None = Field(None, description="none: the shaft is free at both ends")
    holder: Body | None = Field(None, description="the tool holder")
    tool: Body | None = Field(None, description="the tool")

    @checked
    def _consistent(self) -> Problems:
        length = sum(segment.length_mm for segment in self.segments)
        for index, bearing in enumerate(self.bearings or ()):
            if bearing.position_mm > length + 1e-6:
                sentence = f"{bearing.position_mm:g} mm lies outside the shaft, which is {length:g} mm long"
                yield ("bearings", index, "position_mm"), sentence
        for index, joint in enumerate(self.joints):
            if joint.after_segment >= len(self.segments):
                sentence = f"must lie between two segments: 1 to {len(self.segments) - 1}"
                yield ("joints", index, "after_segment"), sentence
        for index, place in repeated(joint.after_segment for joint in self.joints):
            yield ("joints", index, "after_segment"), f"there is a joint after segment {place} already"
        if self.tool and not self.holder:
            yield ("tool",), "a tool needs a holder; describe it under `holder`"
        if self.bearings_identified_with and self.rigid_rotary_inertia is None:
            sentence = "bearing properties identified with a setting need it stated: write rigid_rotary_inertia, too"
            yield ("bearings_identified_with",), sentence
        for name in ("holder", "tool"):
            body = getattr(self, name)
            if body and body.joint and not (body.joint.kt_n_per_m > 0.0 and body.joint.kr_nm_per_rad > 0.0):
                yield (name, "joint"), "kt_n_per_m and kr_nm_per_rad must be above 0, or leave the joint out"

    def shaft_sha256(self) -> str:
        """Return a checksum of the shaft, on which bearings that were identified with it depend: of no holder or tool.

        The core of a segment is of the holder's taper, and what is said to people does not count.
        """
        words = {"origin", "note"}
        parts = self.model_dump(
            mode="json",
            include={"structural_damping", "segments", "joints"},
            exclude={"segments": {"__all__": {"core", *words}}, "joints": {"__all__": words}},
            exclude_defaults=True,
        )
        supports = [(bearing.position_mm, bearing.group) for bearing in self.bearings or ()]
        told = json.dumps([parts, supports], sort_keys=True)
        materials = {
            name: each.model_dump(mode="json", exclude=words, exclude_defaults=True)
            for name, each in self.materials.items()
            if json.dumps(name) in told
        }
        return sha256_of((told + json.dumps(materials, sort_keys=True)).encode())


class _Materials(Section):
    """The shipped materials."""

    materials: dict[Name, MaterialDescription]


def load_spindle(path: Path) -> SpindleDescription:
    """Return a spindle file, whose materials are checked when it is built; raises ConfigurationError."""
    return load_yaml_model(path, SpindleDescription)


def spindle_folder() -> Path:
    return Path(__file__).parent / "data" / "spindles"


def shipped_spindles() -> tuple[str, ...]:
    return tuple(sorted(path.stem for path in spindle_folder().glob("*.yaml")))


def shipped_materials() -> dict[str, MaterialDescription]:
    return dict(_read_materials().materials)


@cache
def _read_materials() -> _Materials:
    return load_yaml_model(Path(__file__).parent / "data" / "materials.yaml", _Materials)
