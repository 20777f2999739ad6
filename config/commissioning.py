"""The record of a commissioning: proof that sign, scale and axis of the compensation are right."""

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from pydantic import Field, ValidationError, model_validator

from config.schema.base import Section
from config.schema.cnc import MacroMapConfig

LEAST_PROOF_UM = 2.0
"""A smaller offset proves neither sign nor scale [um]."""
PROOF_TOLERANCE = 0.2
"""Share by which the measured movement may differ from what sign and scale say."""


class CommissionedAxis(Section):
    """One axis that a person has seen moving the right way."""

    sign: Literal[-1, 1] = Field(description="+1 or -1: direction in which a positive macro value moved the tool point")
    scale: float = Field(ge=0.2, le=5.0, description="movement over macro value, 1 when they agree")
    written_um: float = Field(description="offset that was written [um]")
    measured_um: float = Field(description="movement that was measured [um]")

    @model_validator(mode="after")
    def _proved(self) -> "CommissionedAxis":
        if abs(self.written_um) < LEAST_PROOF_UM:
            raise ValueError(f"written_um {self.written_um:g} is too small to prove anything ({LEAST_PROOF_UM:g} um)")
        expected_um = self.sign * self.scale * self.written_um
        if abs(self.measured_um - expected_um) > PROOF_TOLERANCE * abs(expected_um):
            raise ValueError(
                f"sign and scale make {expected_um:g} um of {self.written_um:g} um written, "
                f"but {self.measured_um:g} um were measured"
            )
        return self


class CommissioningRecord(Section):
    """Who saw which axes of which control move, and through which macros."""

    format_version: int = Field(1, ge=1, le=1)
    cnc_identity: str
    macro_map_sha256: str
    person: str
    date: str
    axes: dict[str, CommissionedAxis]


class CommissioningError(Exception):
    """The record cannot be read; the text says why."""


def macro_map_digest(macros: MacroMapConfig) -> str:
    """Return a digest of everything that decides what a written value does."""
    content = macros.model_dump(mode="json", exclude={"writable", "tolerance", "request", "safe_flag"})
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def load_commissioning(path: Path) -> CommissioningRecord:
    """Read a record; raises CommissioningError naming file and key."""
    try:
        return CommissioningRecord.model_validate_json(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise CommissioningError(f"{path}: cannot be read ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise CommissioningError(f"{path}: this is no record: byte {error.start} is not UTF-8 text") from error
    except ValidationError as error:
        first = error.errors()[0]
        raise CommissioningError(f"{path}: {'.'.join(map(str, first['loc']))}: {first['msg']}") from error


def commissioning_obstacle(
    record: CommissioningRecord | None, *, cnc_identity: str, macros: MacroMapConfig, axes: Sequence[str]
) -> str:
    """Return why these axes may not be compensated, '' when the record covers them."""
    if record is None:
        return "this machine has no commissioning record, so nobody has proved sign and scale"
    if record.cnc_identity != cnc_identity:
        return f"the commissioning record is for {record.cnc_identity!r}, this control is {cnc_identity!r}"
    if record.macro_map_sha256 != macro_map_digest(macros):
        return "the macro map has changed since the commissioning"
    if missing := [axis for axis in axes if axis not in record.axes]:
        return f"not commissioned: axis {', '.join(missing)}"
    return ""
