"""Common base of all configuration sections."""

from collections.abc import Mapping, Sequence
from typing import Annotated, ClassVar

from pydantic import BaseModel, ConfigDict, Field

KeyPath = tuple[str | int, ...]


class Section(BaseModel):
    """A configuration section: unknown keys are refused, types are strict, values are frozen."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)
    shipped: ClassVar[Mapping[str, str]] = {}
    """Keys whose paths may be bare names of YAML files that ship -> the folder of this package where they lie."""


class KeyProblems(ValueError):
    """What a section's own check refuses, with the keys it means (paths relative to the section)."""

    def __init__(self, problems: Sequence[tuple[KeyPath, str]]) -> None:
        self.problems = tuple(problems)
        super().__init__("; ".join(sentence for _, sentence in self.problems))


NAME_PATTERN = r"^[A-Za-z][A-Za-z0-9_]*$"
RANGE_PATTERN = r"^\d+-\d+$"
NUMBER_OR_RANGE_PATTERN = r"^\d+(-\d+)?$"
READ_AHEAD_STOP_PATTERN = r"^(G53|M[1-9]\d{0,2})$"
ENDPOINT_PATTERN = r"^opc\.tcp://[^\s/]+"

FORMS = {
    NAME_PATTERN: "letters, digits and underscores, a letter first",
    RANGE_PATTERN: "a range such as 7-12",
    NUMBER_OR_RANGE_PATTERN: 'a number or a range in quotes, such as "120" or "500-549"',
    READ_AHEAD_STOP_PATTERN: "G53, or an M code such as M150",
    ENDPOINT_PATTERN: "an address such as opc.tcp://192.0.2.10:4840/path",
}
"""What the patterns ask for, in words."""

Seconds = Annotated[float, Field(gt=0)]
Days = Annotated[float, Field(gt=0)]
MacroNumber = Annotated[int, Field(ge=1, le=99999)]
Name = Annotated[str, Field(pattern=NAME_PATTERN, max_length=40)]
