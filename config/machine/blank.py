"""An impact test on a blank in the holder, and the tools that are to stand in its place (YAML)."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from pydantic import Field

from config.loader import load_yaml_model, with_absolute_paths
from config.machine.spindle import Constants, MaterialDescription, SegmentDescription
from config.machine.spindle_chain import ChainBuilder
from config.schema.base import KeyPath, Name, Problems, Section, checked
from models.dynamics.beam import Segment

Responses = Annotated[list[Path], Field(min_length=1)]
SAME_SHANK_MM = 0.05
THINNEST_MM = 0.1


class BlankResponses(Section):
    """Measured responses (CSV or universal file); several at one place are averaged. Relative to this file's folder."""

    tip: Responses = Field(description="hit and measured at the tip of the blank")
    cross: Responses = Field(description="hit at the tip, measured at the second point, or the other way round")
    second: Responses = Field(description="hit and measured at the second point")


class BlankTest(Section):
    """A plain cylinder in the holder instead of a tool, hit at its tip and at a second point."""

    note: str | None = Field(None, description="what a reader should know: machine, holder, direction, temperatures")
    blank: SegmentDescription = Field(description="the cylinder, as far as it stands out of the holder")
    second_point_mm: float = Field(ge=0.01, description="distance of the second point from the tip [mm]")
    responses: BlankResponses = Field(description="the three measured responses")
    structural_damping: float = Field(0.002, ge=0, lt=0.5, description="zeta of the blank's E (1 + j zeta)")
    materials: dict[Name, MaterialDescription] = Field({}, description="materials beside the shipped ones")

    @checked
    def _consistent(self) -> Problems:
        if self.second_point_mm >= self.blank.length_mm:
            sentence = f"must lie between the tip and the holder, {self.blank.length_mm:g} mm behind it"
            yield ("second_point_mm",), sentence


class FlutedTool(Constants):
    """A tool: a shank, and a fluted part that bends like a cylinder of a smaller diameter."""

    diameter_mm: float = Field(ge=0.1, le=500, description="cutting diameter [mm]")
    flute_length_mm: float = Field(ge=0.1, le=1000, description="length of the fluted part from the tip [mm]")
    equivalent_ratio: float = Field(
        0.8, gt=0.3, le=1, description="diameter of the cylinder that bends as the fluted part does, over diameter_mm"
    )
    shank_mm: float = Field(ge=0.1, le=500, description="diameter of the shank [mm]; the blank's in the same holder")
    stickout_mm: float = Field(ge=0.1, le=1000, description="length out of the holder, flutes included [mm]")
    structural_damping: float = Field(0.002, ge=0, lt=0.5, description="zeta of E (1 + j zeta)")

    @checked
    def _consistent(self) -> Problems:
        if not self.material:
            yield from self._missing()
        if self.flute_length_mm > self.stickout_mm:
            sentence = f"{self.flute_length_mm:g} mm are longer than the tool stands out, {self.stickout_mm:g} mm"
            yield ("flute_length_mm",), sentence
        if (bends_mm := self.equivalent_ratio * self.diameter_mm) < THINNEST_MM:
            sentence = f"bends like a cylinder of {bends_mm:.2g} mm, and a beam is computed from {THINNEST_MM:g} mm on"
            yield ("diameter_mm",), sentence

    def sections(self) -> list[SegmentDescription]:
        """Return the tool as a chain of cylinders from the tip backwards."""
        given = self.model_dump(include=set(Constants.model_fields), exclude_none=True)
        fluted = SegmentDescription(
            length_mm=self.flute_length_mm, outer_mm=self.equivalent_ratio * self.diameter_mm, **given
        )
        if self.stickout_mm - self.flute_length_mm < 0.01:
            return [fluted]
        behind = self.stickout_mm - self.flute_length_mm
        return [fluted, SegmentDescription(length_mm=behind, outer_mm=self.shank_mm, **given)]


class ToolLibrary(Section):
    """Tools by name."""

    materials: dict[Name, MaterialDescription] = Field({}, description="materials beside the shipped ones")
    tools: dict[Name, FlutedTool] = Field(min_length=1, description="the tools")


@dataclass(frozen=True, slots=True, kw_only=True)
class Blank:
    """A blank test with its beam."""

    test: BlankTest
    beam: Segment


def read_blank(path: Path) -> Blank:
    """Return a test; raises ConfigurationError with file, line and key."""
    test = with_absolute_paths(load_yaml_model(path, BlankTest), path.resolve().parent)
    builder = ChainBuilder(test.materials, path, "correct")
    built = builder.segments([test.blank], ("blank",), test.structural_damping)
    builder.check()
    return Blank(test=test, beam=built[0])


def read_tools(path: Path, blank: Blank) -> dict[str, tuple[Segment, ...]]:
    """Return the tools of a library as beams, from the tip backwards; raises ConfigurationError."""
    library = load_yaml_model(path, ToolLibrary)
    builder = ChainBuilder(library.materials, path, "correct")
    found = {}
    for name, tool in library.tools.items():
        at: KeyPath = ("tools", name)
        if abs(tool.shank_mm - blank.test.blank.outer_mm) > SAME_SHANK_MM:
            builder.problems.append((
                (*at, "shank_mm"),
                f"the blank was {blank.test.blank.outer_mm:g} mm thick: a shank of {tool.shank_mm:g} mm is held by "
                "another holder or collet, whose own test is needed",
            ))  # fmt: skip
        found[name] = tuple(builder.segments(tool.sections(), at, tool.structural_damping))
    builder.check()
    return found


__all__ = ["Blank", "BlankTest", "FlutedTool", "ToolLibrary", "read_blank", "read_tools"]
