"""The record of a commissioning: proof that sign, scale and axis of the compensation are right."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal

from pydantic import Field, ValidationError, model_validator

from config.files import read_whole
from config.schema.base import Section, first_fault
from config.schema.cnc import CHECK_MISSING, MacroMapConfig
from config.schema.compensation import SlopeConfig
from config.signing import SigningError, TrustedKeys, signature_of
from models.errors import RefusedInputError

LEAST_PROOF_UM = 2.0
"""A smaller offset proves neither sign nor scale [um]."""
PROOF_TOLERANCE = 0.2
"""Share by which the measured movement may differ from what sign and scale say."""
RECORD_FORMAT = 2
"""Format that is written. Format 1 named no guard version, so it permits nothing once the guard's version is known."""
READING_SLACK_UM = 0.01
"""Rounding of the readings in the record [um]."""


class AxisReadings(Section):
    """What the instrument showed before the offset, with it, and back at zero."""

    source: str = Field(description="who or what read: a person, or a displacement channel")
    before_um: float = Field(description="reading at zero, before [um]")
    at_offset_um: float = Field(description="reading with the offset applied [um]")
    after_um: float = Field(description="reading back at zero [um]")
    noise_um: float | None = Field(None, ge=0, description="standard deviation of the samples, where a channel read")
    samples: int = Field(1, ge=1, description="samples per reading")

    @property
    def moved_um(self) -> float:
        """Movement against the mean of both zeros, which takes a steady drift out [um]."""
        return self.at_offset_um - 0.5 * (self.before_um + self.after_um)


class CommissionedSlope(Section):
    """Which slope a person has seen, and where."""

    of: str = Field(description="axis that it acts on")
    pivot_mm: float = Field(description="machine position at which it adds nothing [mm]")
    positions_mm: tuple[float, float] = Field(description="machine positions at which the instrument was read [mm]")


class CommissionedAxis(Section):
    """One axis that a person has seen moving the right way."""

    sign: Literal[-1, 1] = Field(description="+1 or -1: direction in which a positive macro value moved the tool point")
    scale: float = Field(ge=0.2, le=5.0, description="movement over macro value, 1 when they agree")
    written_um: float = Field(description="offset that was written [um]")
    measured_um: float = Field(description="movement that was measured [um]")
    readings: AxisReadings | None = Field(None, description="what the instrument showed")
    others_um: dict[str, float] = Field(
        default_factory=dict, description="movement of the axes that were not commanded, as far as observed [um]"
    )
    slope: CommissionedSlope | None = Field(
        None, description="of a slope: the movement is that of the second position against the first; else left out"
    )

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
        if self.readings is not None and abs(self.readings.moved_um - self.measured_um) > READING_SLACK_UM:
            raise ValueError(
                f"the readings make a movement of {self.readings.moved_um:g} um, measured_um says {self.measured_um:g}"
            )
        return self


class CommissioningRecord(Section):
    """The proof that axes of a control move the right way, through which macros and which guard."""

    format_version: int = Field(RECORD_FORMAT, ge=1, le=RECORD_FORMAT)
    cnc_identity: str = Field(description="what the control calls itself")
    macro_map_sha256: str = Field(description="digest of the macro map, `macro_map_digest`")
    guard_version: int | None = Field(None, description="version that the guard echoed")
    guard_program_sha256: str | None = Field(None, description="digest of the guard program's text, where it was given")
    person: str = Field(min_length=1, description="who read the instrument and answers for it")
    date: str = Field(description="day of the commissioning, ISO 8601")
    machine: str = Field("", description="name of the machine in its configuration")
    instrument: str = Field("", description="what the movement was measured with")
    software: str = Field("", description="version of Toolpoint that made the record")
    axes: dict[str, CommissionedAxis]

    @model_validator(mode="after")
    def _guard_named(self) -> "CommissioningRecord":
        if self.format_version > 1 and self.guard_version is None:
            raise ValueError("guard_version is missing; a record of format 2 names the guard it was made with")
        return self


class CommissioningError(RefusedInputError):
    """The record cannot be read or written; the text says why."""


def macro_map_digest(macros: MacroMapConfig) -> str:
    """Return a digest of everything that decides what a written value does."""
    return macros.digest


def load_commissioning(path: Path, trusted: Path | None = None) -> CommissioningRecord:
    """Read a record, signed by one of the `trusted` keys where there are any; raises CommissioningError."""
    try:
        content = read_whole(path)
        if trusted is not None:
            TrustedKeys.read(trusted).signer("commissioning record", content, signature_of(path), str(path))
        return CommissioningRecord.model_validate_json(content.decode("utf-8"))
    except SigningError as error:
        raise CommissioningError(str(error)) from error
    except OSError as error:
        raise CommissioningError(f"{path}: cannot be read ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise CommissioningError(f"{path}: this is no record: byte {error.start} is not UTF-8 text") from error
    except ValidationError as error:
        raise CommissioningError(f"{path}: {first_fault(error)}") from error


ADVICE = "run `toolpoint commission`"
CHECKING_GUARD = 2
"""First version of the guard that applies a block only when its check fits; no older one is enabled."""


def commissioning_inhibit(
    record: CommissioningRecord | None,
    *,
    cnc_identity: str,
    macros: MacroMapConfig,
    axes: Sequence[str],
    guard_version: float | None = None,
    slopes: Mapping[str, SlopeConfig] | None = None,
    machine: str = "",
) -> str:
    """Return why these axes may not be compensated, '' when the record covers them; None: what is not known yet."""
    if record is None:
        return f"this machine has no commissioning record, so sign and scale have not been proved: {ADVICE}"
    if record.cnc_identity != cnc_identity:
        return (
            f"the commissioning record is for {record.cnc_identity!r}, this control is {cnc_identity!r}: "
            f"{ADVICE} on this control, or name its own record (compensation.commissioning_file)"
        )
    if machine and record.machine not in ("", machine):
        return (
            f"the commissioning record is of machine {record.machine!r}, this one is {machine!r} (machine): {ADVICE} "
            "on this machine, or give it its name back"
        )
    if record.macro_map_sha256 != macro_map_digest(macros):
        return (
            "the macro map has changed since the commissioning, so the record proves nothing about it: "
            f"take the change of cnc.macros back, or {ADVICE} again"
        )
    if missing := [axis for axis in axes if axis not in record.axes]:
        return f"not commissioned: axis {', '.join(missing)}; {ADVICE} for it"
    for axis in axes:
        if changed := _slope_inhibit(axis, record.axes[axis].slope, (slopes or {}).get(axis)):
            return changed
    if axes and macros.check is None:
        return f"cnc.macros.check {CHECK_MISSING}"
    if axes and record.guard_version is not None and (older := older_guard(record.guard_version)):
        return f"the commissioning was made with {older}, and {ADVICE} again"
    return "" if guard_version is None else _guard_inhibit(record, guard_version)


def _slope_inhibit(axis: str, proved: CommissionedSlope | None, slope: SlopeConfig | None) -> str:
    """Return that an axis was proved as an offset and is a slope, the other way round, or a slope elsewhere."""
    was, now = (None if one is None else (one.of, one.pivot_mm) for one in (proved, slope))
    if was == now:
        return ""
    words = ["an offset" if one is None else f"a slope of {one[0]} about {one[1]:g} mm" for one in (was, now)]
    return (
        f"axis {axis} was commissioned as {words[0]} and is {words[1]} now (compensation.axes.{axis}.slope): load the "
        f"guard's text again, and {ADVICE} for it"
    )


def older_guard(guard_version: float) -> str:
    """Return what is wrong with a guard that does not check the block, '' for one that does."""
    if guard_version >= CHECKING_GUARD:
        return ""
    return (
        f"guard version {guard_version:g}, which applies a block whose check does not fit: load the text that "
        "`toolpoint guard` prints"
    )


def _guard_inhibit(record: CommissioningRecord, guard_version: float) -> str:
    if record.guard_version is None:
        return (
            f"the commissioning record is of format {record.format_version} and does not say which guard it was made "
            f"with, the control runs version {guard_version:g}: {ADVICE} again"
        )
    if record.guard_version != guard_version:
        return (
            f"the control runs guard version {guard_version:g}, the commissioning was made with version "
            f"{record.guard_version}: load that version again, or {ADVICE} with the new one"
        )
    return ""
