"""The CNC: how it is polled, and which of its macro variables are ours."""

import hashlib
import json
import math
from functools import cached_property
from typing import Annotated, Literal

from pydantic import BeforeValidator, Field

from config.schema.base import (
    AXIS_PATTERN,
    NUMBER_OR_RANGE_PATTERN,
    KeyPath,
    MacroNumber,
    Name,
    Problems,
    Seconds,
    Section,
    checked,
)
from config.schema.cnc_drivers import LATEST_T, CncDriverConfig
from config.schema.guard import SHOWN, GuardConfig
from config.schema.temperatures import expand_ranges


def _number_as_text(entry: object) -> object:
    return str(entry) if isinstance(entry, int) and not isinstance(entry, bool) else entry


MacroRange = Annotated[
    str,
    Field(pattern=NUMBER_OR_RANGE_PATTERN),
    BeforeValidator(
        _number_as_text, json_schema_input_type=int | Annotated[str, Field(pattern=NUMBER_OR_RANGE_PATTERN)]
    ),
]


class RequestMacrosConfig(Section):
    """The handshake: macros through which the NC program asks the daemon for something."""

    counter: MacroNumber = Field(
        description="raised by one by the NC after the other macros of the request are set", examples=[520]
    )
    kind: MacroNumber = Field(description="1 reference, 2 probe, 3 tool change", examples=[521])
    axis: MacroNumber = Field(
        description="which axis, counted from 1 in the order of compensation.axes; 0: all", examples=[522]
    )
    value_mm: MacroNumber = Field(
        description="probe: measured deviation, actual minus nominal [mm]; tool change: tool number", examples=[523]
    )
    acknowledge: MacroNumber = Field(
        description="written by the daemon: the counter when the request was taken, minus the counter when refused",
        examples=[524],
    )


CHECK_MISSING = (
    "names no variable, so the guard cannot recognise a foreign value in the block, and no axis is enabled: name one "
    "within `cnc.macros.writable` that nothing else uses, load the text that `toolpoint guard` prints, and run "
    "`toolpoint commission` again"
)
"""What is wrong with `cnc.macros.check` where it is not given."""


class MacroMapConfig(Section):
    """The block of macro variables that carries compensation to the CNC, and its echo."""

    writable: list[MacroRange] = Field(
        description="the only macro variables that may ever be written, as numbers or ranges",
        examples=[["120-121", "500-549"]],
    )
    sequence_a: MacroNumber = Field(
        description="written first; equal to sequence_b when the block is whole", examples=[500]
    )
    sequence_b: MacroNumber = Field(description="written last", examples=[505])
    check: MacroNumber | None = Field(
        None,
        description="a whole number made of all others of the block; the guard makes it anew and applies nothing where "
        "the two differ. Name one within `writable` that nothing else uses; without it no axis is enabled",
        examples=[506],
    )
    valid_until: MacroNumber = Field(
        description="CNC clock until which the block is valid [s]; must lie where power-off clears it (100-199)",
        examples=[120],
    )
    enable: MacroNumber = Field(description="one bit per axis, in the order of compensation.axes", examples=[504])
    values: dict[Name, MacroNumber] = Field(description="compensation per axis", examples=[{"z": 503}])
    echo_applied: dict[Name, MacroNumber] = Field(
        description="what the guard has applied, per axis", examples=[{"z": 513}]
    )
    echo_time: MacroNumber = Field(description="CNC clock when the guard last ran [s]", examples=[514])
    echo_status: MacroNumber = Field(description="what the guard did: 0 applied, else its refusal", examples=[515])
    echo_guard_version: MacroNumber = Field(description="version of the guard macro", examples=[516])
    request: RequestMacrosConfig | None = Field(
        None, description="handshake with the NC program; none: sequence numbers alone set the reference"
    )
    safe_flag: MacroNumber | None = Field(
        None, description="set to 1 by the NC program while the tool is at a safe point, else 0", examples=[517]
    )
    unit_um: float = Field(
        1000.0, ge=0.01, le=25400.0, description="micrometres per unit of the value macros (1000: mm)"
    )
    tolerance: float = Field(
        1e-6, ge=1e-8, le=1e-3, description="largest difference between written and read back, in the macros' unit"
    )

    @checked
    def _allowed(self) -> Problems:
        seen: dict[int, str] = {}
        for key, number in self._numbers():
            if number in seen:
                yield key, f"#{number} is used twice: it is {seen[number]} already"
            seen.setdefault(number, ".".join(str(step) for step in key))
            if _written_by_us(key) and number not in self.allowed:
                yield key, f"#{number} lies outside `writable` ({', '.join(self.writable)})"
        if set(self.values) != set(self.echo_applied):
            yield ("echo_applied",), f"must name the same axes as `values`: {sorted(self.values)}"
        if uncommon := sorted(n for n in self.allowed if not (100 <= n <= 199 or 500 <= n <= 999)):
            yield ("writable",), f"only common variables (#100-#199, #500-#999) are ours, not #{uncommon[0]}"
        if not 100 <= self.valid_until <= 199:
            yield ("valid_until",), "must be one of #100-#199, which power-off clears"

    def _numbers(self) -> list[tuple[KeyPath, int]]:
        """Return every macro with the key that names it: ours first, then the echo."""
        return [
            (("sequence_a",), self.sequence_a),
            (("sequence_b",), self.sequence_b),
            (("valid_until",), self.valid_until),
            (("enable",), self.enable),
            *([(("check",), self.check)] if self.check is not None else []),
            *((("values", axis), number) for axis, number in self.values.items()),
            *((("echo_applied", axis), number) for axis, number in self.echo_applied.items()),
            (("echo_time",), self.echo_time),
            (("echo_status",), self.echo_status),
            (("echo_guard_version",), self.echo_guard_version),
            *((("request", name), number) for name, number in self.request_macros.items()),
            *([(("safe_flag",), self.safe_flag)] if self.safe_flag is not None else []),
        ]

    @cached_property
    def digest(self) -> str:
        """SHA-256 of everything that decides what a written value does."""
        unsaid = {"check"} if self.check is None else set()
        content = self.model_dump(mode="json", exclude={"writable", "tolerance", "request", "safe_flag"} | unsaid)
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()

    @property
    def request_macros(self) -> dict[str, int]:
        """Macro of each part of the handshake, by its key; empty without a handshake."""
        return self.request.model_dump() if self.request is not None else {}

    @cached_property
    def allowed(self) -> frozenset[int]:
        """Numbers of all macro variables that may be written."""
        return frozenset(expand_ranges([entry if "-" in entry else f"{entry}-{entry}" for entry in self.writable]))

    @cached_property
    def block(self) -> tuple[int, ...]:
        """All macro variables that are polled: ours first, then the echo, the handshake and the flag."""
        return (
            self.sequence_a,
            *self.values.values(),
            self.valid_until,
            self.enable,
            *([self.check] if self.check is not None else []),
            self.sequence_b,
            *self.echo_applied.values(),
            self.echo_time,
            self.echo_status,
            self.echo_guard_version,
            *self.request_macros.values(),
            *([self.safe_flag] if self.safe_flag is not None else []),
        )


def _written_by_us(key: KeyPath) -> bool:
    """Whether the daemon writes this macro; the others are the NC's."""
    return (
        not str(key[0]).startswith("echo")
        and key[0] != "safe_flag"
        and (key[0] != "request" or key[1] == "acknowledge")
    )


class TemperatureMacroConfig(Section):
    """A macro of its own that shows one temperature, for commissioning and for measuring the delay; moves nothing."""

    sensor: int = Field(ge=1, description="ID of the sensor", examples=[1])
    macro: MacroNumber = Field(
        description="written whenever the value changes [degC]; within `macros.writable`, and nothing else's",
        examples=[549],
    )
    cleansed: bool = Field(
        False, description="the value after cleansing, which holds a step back, instead of the value as measured"
    )


MOST_UM_OF_HAAS = 1000.0
SPEED = "spindle speed"
_PLACE = ("driver", "preset", "namespace_uri", "path", "device")
OF_SPEED = (*_PLACE, "spindle_speed", "spindle_speed_macro", "spindle_speed_item")
OF_POSITIONS = (*_PLACE, "axis_position", "position_items")
"""Keys of a driver's section that decide what is read as spindle speed, and as axis positions."""
AXIS_NUMBERS = {"X": 1, "Y": 2, "Z": 3}
ROTARY = "ABC"


class AxisPositionConfig(Section):
    """One axis position that is read from the control: of the machine's coordinates, kept in mm."""

    axis: str = Field(pattern=AXIS_PATTERN, description="letter of the axis on the control", examples=["Z"])
    number: int | None = Field(None, ge=1, le=32, description="its number there; none: X 1, Y 2, Z 3", examples=[3])
    unit: Literal["mm", "inch"] = Field(
        "mm", description="unit of the control's machine coordinates, where the control itself does not say it"
    )
    travel_mm: tuple[float, float] = Field(
        description="lowest and highest machine position [mm]; a value outside counts as none", examples=[[0.0, 500.0]]
    )
    rapid_mm_per_min: float = Field(
        gt=0,
        allow_inf_nan=False,
        description="the axis never moves faster [mm/min]; a value that it cannot have reached counts as none",
        examples=[30000.0],
    )

    @checked
    def _sensible(self) -> Problems:
        lowest, highest = self.travel_mm
        if self.axis[0] in ROTARY:
            yield ("axis",), f"{self.axis} turns: its degrees roll over and are no mm; name a linear axis"
        elif not -math.inf < lowest < highest < math.inf:
            yield ("travel_mm",), "the lowest position comes first, then the highest [mm]"
        elif self.number is None and self.axis not in AXIS_NUMBERS:
            yield ("number",), f"is missing: which number axis {self.axis} has is not usual"

    @property
    def place(self) -> int:
        """Number of the axis on the control, from 1."""
        return self.number or AXIS_NUMBERS[self.axis]


class CncConfig(CncDriverConfig):
    """The CNC."""

    poll_period_s: Seconds = Field(0.5, description="time between polls of the CNC's state")
    timeout_s: Seconds = Field(1.0, description="every call ends after this long [s of the wall clock]")
    stale_after_s: Seconds = Field(
        3.0, description="without an answer, or with its clock standing still, for this long the link counts as lost"
    )
    macros: MacroMapConfig = Field(description="macro variables", examples=[{"check": 506}])
    temperature_macro: TemperatureMacroConfig | None = Field(
        None, description="one temperature in a macro of its own; none: off"
    )
    axis_positions: dict[Name, AxisPositionConfig] = Field(
        default_factory=dict,
        max_length=9,
        description="axis positions that are read and recorded, by the name of their column in recordings; needed by "
        "models that were trained with them",
        examples=[{"Z_mm": {"axis": "Z", "travel_mm": [0.0, 500.0], "rapid_mm_per_min": 30000.0}}],
    )
    guard: GuardConfig = Field(default_factory=GuardConfig, description="guard macro that the CNC runs at safe points")

    @property
    def reads(self) -> dict[str, str]:
        """What is read as spindle speed and as each axis position, by what an input of a model is called."""
        said = self.connection.model_dump(mode="json", exclude_defaults=True)
        said |= {"driver": self.driver} | (said.get("nodes") or {})
        speed, position = (" ".join(f"{said[key]}" for key in keys if key in said) for keys in (OF_SPEED, OF_POSITIONS))
        axes = self.axis_positions.items()
        return {SPEED: speed} | {f"axis position {n}": f"{position} {a.axis} {a.place} {a.unit}" for n, a in axes}

    @property
    def is_sinumerik(self) -> bool:
        """Whether the control is a SINUMERIK, whose R parameters are the macro variables."""
        return self.opcua is not None and self.opcua.preset == "sinumerik"

    @property
    def takes_slopes(self) -> bool:
        """Whether this control's guard applies a slope along an axis."""
        return self.driver in ("opcua", "focas", "linuxcnc")

    @property
    def tells_prepared_tool(self) -> bool:
        """Whether the number that is read is the latest T word: the tool of it may only be prepared."""
        return self.focas is not None and self.focas.tool_macro == LATEST_T

    @property
    def watches_offset(self) -> bool:
        """Whether the external offset is polled, to notice who changes it beside the guard."""
        asked = self.guard.watch_offset
        return self.driver in ("focas", "haas") if asked is None else asked

    @checked
    def _guard_of_the_control(self) -> Problems:
        wanted = "sinumerik" if self.is_sinumerik else "linuxcnc" if self.driver == "linuxcnc" else "fanuc"
        if self.guard.dialect != wanted:
            sentence = f"must be {wanted} for this control (cnc.driver, cnc.opcua.preset): it runs no guard in another"
            yield ("guard", "dialect"), f"{sentence} language"
        elif self.guard.watch_offset and (wanted != "fanuc" or self.driver == "mtconnect"):
            yield ("guard", "watch_offset"), "this control's offset is no system variable #5201.."
        elif self.driver == "haas" and self.macros.unit_um > MOST_UM_OF_HAAS:
            sentence = (
                f"at most {MOST_UM_OF_HAAS:g} (mm): a Haas takes six decimals, and with larger units, as inches, "
            )
            yield ("macros", "unit_um"), sentence + "no value is whole nanometres, so no check ever fits"

    @checked
    def _memory_apart(self) -> Problems:
        memory = self.guard.memory_of(len(self.macros.values))
        key = ("guard", "memory")
        if memory[-1] > 999:
            yield key, f"it needs #{memory[0]} to #{memory[-1]}; there are macros up to #999"
        elif taken := sorted(set(memory) & {*self.macros.block, *self.macros.allowed}):
            yield key, f"#{taken[0]} (of #{memory[0]} to #{memory[-1]}) is in the macro map or in `writable` already"
        shown = {*range(self.guard.shown, self.guard.shown + SHOWN)}
        if self.is_sinumerik and (taken := sorted(shown & {*memory, *self.macros.block, *self.macros.allowed})):
            sentence = f"R{taken[0]} is in the guard's memory, in the macro map or in `writable` already"
            yield ("guard", "shown"), sentence

    @checked
    def _temperature_has_its_own_macro(self) -> Problems:
        if self.temperature_macro is None:
            return
        number, at = self.temperature_macro.macro, ("temperature_macro", "macro")
        if number in self.macros.block:
            yield at, f"#{number} belongs to the block, its echo or the handshake (macros)"
        elif number not in self.macros.allowed:
            sentence = f"#{number} lies outside `macros.writable` ({', '.join(self.macros.writable)})"
            yield at, sentence

    @checked
    def _ordered(self) -> Problems:
        if self.stale_after_s <= self.poll_period_s:
            yield ("stale_after_s",), "must be longer than poll_period_s, or the link would always count as lost"
