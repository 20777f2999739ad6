"""Turns the description of a spindle into the chain that the beam models take."""

import difflib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from config.files import read_whole
from config.loader import key_text
from config.machine.spindle import (
    Body,
    Constants,
    MaterialDescription,
    Rotary,
    SegmentDescription,
    SpindleDescription,
    Springs,
    load_spindle,
    shipped_materials,
    shipped_spindles,
    spindle_folder,
)
from config.schema.base import ConfigurationError, KeyPath, Problem
from config.yaml_document import YamlDocument, read_yaml
from models.dynamics.assembly import SpindleAssembly
from models.dynamics.beam import Segment
from models.dynamics.chain import Chain, Part, SpringDamper, Support
from models.dynamics.mixture import CELLS, Layer, Material, layered, mixed
from models.dynamics.section import Elasticity, Tube, beam_segment

GPA = 1e9
G_CM3 = 1e3
MM = 1e-3


@dataclass(frozen=True, slots=True, kw_only=True)
class Spindle:
    """A spindle that was built from a file."""

    description: SpindleDescription
    rotary: Rotary
    shaft: Chain
    holder: tuple[Part, ...]
    """The holder from its front to the joint at the nose; empty without one."""
    tool: tuple[Part, ...]
    """The tool from its tip to the joint in the holder; empty without one."""
    warnings: tuple[str, ...]

    def assembly(self, at: str = "tool") -> SpindleAssembly:
        """Return the bare spindle (`nose`), with its holder (`holder`), or with its tool (`tool`)."""
        front = {"nose": (), "holder": self.holder, "tool": (*self.tool, *self.holder)}[at]
        return SpindleAssembly(shaft=self.shaft, front=front)


def build_spindle(
    description: SpindleDescription, file: Path, rotary: Rotary | None = None, cells: int = CELLS
) -> Spindle:
    """Return the chain of a description; raises ConfigurationError where a material or its Poisson's ratio is missing.

    `rotary` overrides the file's setting. `cells`: unit cells along each side of a mixed or layered section.
    """
    return _builder(description, file, rotary, cells).build(description)


def segment_elasticity(description: SpindleDescription, segment: SegmentDescription, file: Path) -> Elasticity:
    """Return the equivalent constants of a segment's own section; raises ConfigurationError."""
    builder = _builder(description, file, None, CELLS)
    found = builder.section(segment, ())
    if found is None:
        raise ConfigurationError(_located(file, builder.problems))
    return found


def _builder(description: SpindleDescription, file: Path, rotary: Rotary | None, cells: int) -> "ChainBuilder":
    return ChainBuilder(description.materials, file, rotary or description.rigid_rotary_inertia or "correct", cells)


class ChainBuilder:
    """Builds parts from descriptions; what is wrong is gathered with the key that it stands at."""

    def __init__(
        self, materials: Mapping[str, MaterialDescription], file: Path, rotary: Rotary, cells: int = CELLS
    ) -> None:
        """`materials`: those of the file, beside the shipped ones. `file`: for sentences about it."""
        self.file = file
        self.cells = cells
        self.rotary = rotary
        self.materials = {**_materials(shipped_materials()), **_materials(materials)}
        self.problems: list[tuple[KeyPath, str]] = []

    def check(self) -> None:
        """Raise ConfigurationError with everything that was found wrong."""
        if self.problems:
            raise ConfigurationError(_located(self.file, self.problems))

    def build(self, told: SpindleDescription) -> Spindle:
        segments = self.segments(told.segments, ("segments",), told.structural_damping)
        holder = self.body(told.holder, "holder", told.structural_damping)
        tool = self.body(told.tool, "tool", told.structural_damping)
        self.check()
        parts: list[Part] = []
        joints = {joint.after_segment: _spring(joint) for joint in told.joints}
        for number, segment in enumerate(segments, start=1):
            parts.append(segment)
            if number in joints:
                parts.append(joints[number])
        length_m = sum(segment.length_m for segment in segments)
        supports = tuple(
            Support(
                position_m=min(bearing.position_mm * MM, length_m), group=bearing.group, properties=_spring(bearing)
            )
            for bearing in told.bearings or ()
        )
        return Spindle(
            description=told,
            rotary=self.rotary,
            shaft=Chain(parts=tuple(parts), supports=supports),
            holder=holder,
            tool=tool,
            warnings=self.warnings(told),
        )

    def warnings(self, told: SpindleDescription) -> tuple[str, ...]:
        known = told.bearings_identified_with
        if known is None or known == self.rotary:
            return ()
        return (
            f"{self.file}: the bearing properties were identified with rigid_rotary_inertia {known}, but the shaft is "
            f"computed with {self.rotary}; the resonances of such a mixture are shifted (about 10 Hz at the nose)",
        )

    def body(self, body: Body | None, name: str, of_shaft: float) -> tuple[Part, ...]:
        if body is None:
            return ()
        damping = of_shaft if body.structural_damping is None else body.structural_damping
        parts: list[Part] = list(self.segments(body.segments, (name, "segments"), damping))
        if body.joint is not None:
            parts.append(_spring(body.joint))
        return tuple(parts)

    def segments(self, told: list[SegmentDescription], path: KeyPath, damping: float) -> list[Segment]:
        """Return the segments; what is wrong is put to `problems`."""
        built = []
        for index, each in enumerate(told):
            tubes = self.tubes(each, (*path, index))
            if tubes is None:
                continue
            try:
                built.append(
                    beam_segment(
                        each.length_mm * MM,
                        tubes,
                        axial_load_n=each.axial_load_n,
                        structural_damping=damping,
                        rigid_rotary_inertia=self.rotary,
                    )
                )
            except ValueError as error:
                self.problems.append(((*path, index), str(error)))
        return built

    def tubes(self, told: SegmentDescription, path: KeyPath) -> tuple[Tube, ...] | None:
        before = len(self.problems)
        found = [(told.outer_mm, told.inner_mm, self.section(told, path))]
        if told.ring is not None:
            ring = self.constants(told.ring, (*path, "ring"), told.ring.outer_mm, told.outer_mm)
            found.append((told.ring.outer_mm, told.outer_mm, ring))
        if told.core is not None:
            core = self.constants(told.core, (*path, "core"), told.inner_mm, told.core.inner_mm)
            found.append((told.inner_mm, told.core.inner_mm, core))
        if len(self.problems) > before:
            return None
        return tuple(
            Tube(outer_m=outer * MM, inner_m=inner * MM, elasticity=elasticity)
            for outer, inner, elasticity in found
            if elasticity is not None
        )

    def section(self, told: SegmentDescription, path: KeyPath) -> Elasticity | None:
        if told.mixture is None and told.layers is None:
            return self.constants(told, path, told.outer_mm, told.inner_mm)
        names = list(told.mixture or ()) or [layer.material for layer in told.layers or ()]
        keys: list[KeyPath] = [("mixture", name) for name in told.mixture or ()]
        keys = keys or [("layers", index, "material") for index in range(len(names))]
        materials = [self.material(name, (*path, *key)) for name, key in zip(names, keys, strict=True)]
        known = [material for material in materials if material is not None]
        if len(known) < len(materials):
            return None
        try:
            if told.mixture is not None:
                total = sum(told.mixture.values())
                ratios = [(one, told.mixture[one.name] / total) for one in known]
                base = mixed(ratios, told.outer_mm * MM, told.inner_mm * MM, poisson=told.nu, cells=self.cells)
            else:
                layers = [
                    Layer(material=one, outer_m=layer.outer_mm * MM)
                    for one, layer in zip(known, told.layers or (), strict=True)
                ]
                base = layered(layers, told.inner_mm * MM, poisson=told.nu, cells=self.cells)
        except ValueError as error:
            self.problems.append((path, str(error)))
            return None
        return _overridden(base, told)

    def constants(self, told: Constants, path: KeyPath, outer_mm: float, inner_mm: float) -> Elasticity | None:
        """Return constants that are written out, or a material's in such a tube with what overrides it."""
        if told.material is None:
            assert told.E_gpa and told.G_gpa and told.nu is not None and told.density_g_cm3
            return Elasticity(
                young_pa=told.E_gpa * GPA,
                shear_pa=told.G_gpa * GPA,
                poisson=told.nu,
                density_kg_per_m3=told.density_g_cm3 * G_CM3,
            )
        material = self.material(told.material, (*path, "material"))
        if material is None:
            return None
        try:
            base = mixed([(material, 1.0)], outer_mm * MM, inner_mm * MM, poisson=told.nu, cells=self.cells)
        except ValueError as error:
            self.problems.append(((*path, "material"), str(error)))
            return None
        return _overridden(base, told)

    def material(self, name: str, path: KeyPath) -> Material | None:
        if name in self.materials:
            return self.materials[name]
        close = difflib.get_close_matches(name, self.materials, n=1)
        hint = f"; did you mean {close[0]}?" if close else f"; known are {', '.join(self.materials)}"
        self.problems.append((path, f"the material {name!r} is not known{hint}"))
        return None


def _overridden(base: Elasticity, told: Constants) -> Elasticity:
    return Elasticity(
        young_pa=base.young_pa if told.E_gpa is None else told.E_gpa * GPA,
        shear_pa=base.shear_pa if told.G_gpa is None else told.G_gpa * GPA,
        poisson=base.poisson if told.nu is None else told.nu,
        density_kg_per_m3=base.density_kg_per_m3 if told.density_g_cm3 is None else told.density_g_cm3 * G_CM3,
    )


def _materials(told: Mapping[str, MaterialDescription]) -> dict[str, Material]:
    found = {}
    for name, each in told.items():
        radial = each.G_gpa if each.G_zx_gpa is None else each.G_zx_gpa
        tangential = each.G_gpa if each.G_zy_gpa is None else each.G_zy_gpa
        assert radial is not None
        assert tangential is not None
        found[name] = Material(
            name=name,
            density_kg_per_m3=each.density_g_cm3 * G_CM3,
            young_pa=each.E_gpa * GPA,
            shear_radial_pa=radial * GPA,
            shear_tangential_pa=tangential * GPA,
            poisson=each.nu,
        )
    return found


def _spring(told: Springs) -> SpringDamper:
    return SpringDamper(
        kt_n_per_m=told.kt_n_per_m,
        ct_ns_per_m=told.ct_ns_per_m,
        kr_nm_per_rad=told.kr_nm_per_rad,
        cr_nms_per_rad=told.cr_nms_per_rad,
    )


def _located(file: Path, problems: list[tuple[KeyPath, str]]) -> list[Problem]:
    """Return problems found while building with the lines that they stand in."""
    try:
        document = read_yaml(read_whole(file).decode())
    except OSError:
        document = YamlDocument()
    located = []
    for path, sentence in problems:
        known = path
        while known and known not in document.keys:
            known = known[:-1]
        line, column = document.values.get(path) or document.keys.get(known, (1, 1))
        located.append(Problem(file=str(file), line=line, column=column, key=key_text(path), sentence=sentence))
    return located


def found_file(given: Path) -> Path:
    """Return the file that is meant: a path, or the name of a spindle that ships with Toolpoint."""
    if given.exists():
        return given
    shipped = spindle_folder() / f"{given.name}.yaml"
    if given.parent == Path() and shipped.is_file():
        return shipped
    sentence = f"there is no such file; spindles that ship are {', '.join(shipped_spindles())}"
    raise ConfigurationError([Problem(file=str(given), line=1, column=1, key="", sentence=sentence)])


def read_spindle(given: Path, rotary: Rotary | None = None) -> Spindle:
    """Return the spindle of a file or of a shipped name; raises ConfigurationError."""
    path = found_file(given)
    return build_spindle(load_spindle(path), path, rotary)
