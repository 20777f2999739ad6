"""LATSIS lines, their frames, the sensors, other sources, and the cleansing of temperatures."""

import hashlib
from functools import cached_property
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, WithJsonSchema, field_validator

from config.schema.base import RANGE_PATTERN, KeyPath, Name, Problems, Seconds, Section, checked, repeated
from config.schema.source_drivers import SourceConfig
from config.schema.sources import SourceSensorConfig
from models.units import MLX90615_K_PER_LSB, TMP102_DEGC_PER_LSB

_NUMBER: dict[str, Any] = {"type": "integer", "minimum": 1, "maximum": 99_999_999}
SensorNumber = Annotated[
    int,
    Field(ge=1, le=99_999_999),
    WithJsonSchema({"anyOf": [_NUMBER, {"type": "string", "pattern": RANGE_PATTERN}]}),
]
"""The loader puts a sensor for each number in the place of a range (config/loader.py)."""
ChainEntry = Annotated[int, Field(ge=1)] | Annotated[str, Field(pattern=RANGE_PATTERN)]

SAID = {"component", "part", "label", "open", "resolution", "min_degc", "max_degc"}
"""Keys of a sensor that change nothing of what it reads."""
_LOG_IN = ("user_name", "password_file", "tls", "ca_certificate", "security")
_WIRE = ("baud", "parity", "stop_bits", "framing", "timeout_s", "gap", "most_registers", "max_line_bytes")
HOW: dict[str, Any] = dict.fromkeys((*_WIRE, *_LOG_IN), True)
HOW |= {"file": {"poll_period_s", "max_line_bytes", "overflow_tokens"}}
"""Keys of a connection that change nothing of what is read over it."""
LONGEST_RANGE = 100_000
LONGEST_CHAIN = 200
"""Sensors that one LATSIS line can carry."""


class GrammarConfig(Section):
    """Frame grammar of one LATSIS line: [SOF] ID SEP VAL [SEP STAT] ["*" CHK] EOL."""

    start: Literal["", ":"] = Field("", description="character that starts a frame, or none")
    id_digits: int = Field(3, ge=2, le=3, description="hexadecimal digits of the ID")
    separator: Literal["", ",", " "] = Field("", description="between ID, value and status")
    status: bool = Field(False, description="a status byte of two hexadecimal digits follows the value")
    checksum: Literal["none", "sum8", "lrc8", "crc8"] = Field(
        "none", description="over the characters between the start and the asterisk"
    )
    end: Literal["CR", "LF", "CRLF"] = Field("CRLF", description="line end")


BARE = GrammarConfig(id_digits=2)
CHECKED = GrammarConfig(start=":", separator=",", status=True, checksum="sum8", end="CRLF")


class LineConfig(Section):
    """One LATSIS line on one serial port."""

    driver: ClassVar[str] = "latsis"
    """Which driver reads it (`drivers/registry.py`)."""

    name: Name = Field(description="name of the line in logs, history and commands", examples=["spindle"])
    port: str = Field(
        min_length=1,
        description="serial port; prefer /dev/serial/by-id/... or by-path",
        examples=["/dev/serial/by-path/pci-0000:00:14.0-usb-0:1:1.0-port0"],
    )
    baud: int = Field(9600, gt=0, description="baud rate of the port [1/s]")
    profile: Literal["bare", "checked", "custom"] = Field(
        "bare",
        description="frame grammar: checked (16 byte, with a checksum) where the nodes can do it, else bare (7 byte), "
        "which is also what a line without this key has, or custom (give `grammar`)",
    )
    grammar: GrammarConfig | None = Field(None, description="frame grammar; only with profile custom")
    id_offset: int = Field(0, ge=0, description="added to the chain position to give the ID on the wire")
    cycle_period_s: Seconds = Field(10.0, description="time from one pass over the line to the next")
    extended_mode: bool = Field(False, description="TMP102 sensors send 13 bits in four digits")
    chain: list[ChainEntry] = Field(
        min_length=1,
        description="sensor IDs by position on the chain, position 1 first; '7-12' stands for 7, 8 .. 12",
        examples=[["1-4"]],
    )

    @field_validator("chain")
    @classmethod
    def _limit_chain(cls, chain: list[int | str]) -> list[int | str]:
        if (count := len(expand_ranges(chain))) > LONGEST_CHAIN:
            raise ValueError(f"a LATSIS line carries at most {LONGEST_CHAIN} sensors; this chain names {count}")
        return chain

    @checked
    def _grammar_matches_profile(self) -> Problems:
        if (self.profile == "custom") != (self.grammar is not None):
            key = "profile" if self.grammar is None else "grammar"
            yield (key,), "give `grammar` with profile custom, and only then"
        highest, limit = self.id_offset + len(self.sensor_ids), 16**self.frame_grammar.id_digits - 1
        if highest > limit:
            sentence = (
                f"the highest ID on the wire would be {highest}, but {self.frame_grammar.id_digits} hexadecimal "
                f"digits end at {limit}: lower id_offset, shorten the chain, or use a grammar with 3 id_digits"
            )
            yield ("chain",), sentence

    @cached_property
    def sensor_ids(self) -> tuple[int, ...]:
        """Sensor IDs by chain position, position 1 first."""
        return tuple(expand_ranges(self.chain))

    @property
    def frame_grammar(self) -> GrammarConfig:
        """The grammar that the profile stands for."""
        return self.grammar or (CHECKED if self.profile == "checked" else BARE)


def expand_ranges(entries: list[int | str] | list[str] | list[int]) -> list[int]:
    """Return whole numbers from a list of numbers and 'a-b' ranges."""
    numbers: list[int] = []
    for entry in entries:
        if isinstance(entry, int):
            numbers.append(entry)
            continue
        first, last = (int(part) for part in entry.split("-"))
        if last < first:
            raise ValueError(f"the range {entry} runs backwards; write {last}-{first}")
        if last - first >= LONGEST_RANGE:
            raise ValueError(f"the range {entry} holds more than {LONGEST_RANGE} numbers")
        numbers.extend(range(first, last + 1))
    return numbers


class SensorConfig(Section):
    """One temperature sensor."""

    id: SensorNumber = Field(
        description="sensor ID of the machine's documentation; '5-24' stands for twenty sensors with one description",
        examples=[1],
    )
    device: Literal["TMP102", "MLX90615"] = Field("TMP102", description="what decodes its value")
    component: str = Field(min_length=1, description="machine component it sits on", examples=["Spindle unit"])
    part: str = Field("-", description="part of the component; '-': the whole of it")
    label: Name | None = Field(
        None, description="sensors with one label are averaged under that name", examples=["Nose"]
    )

    @property
    def step_k(self) -> float:
        """Step in which it counts [K]."""
        return TMP102_DEGC_PER_LSB if self.device == "TMP102" else MLX90615_K_PER_LSB


class CleansingConfig(Section):
    """Which temperatures count: changes are bounded, and what is above the noise counts once readings agree."""

    noise_degc: float = Field(
        0.3,
        gt=0,
        description="a change up to this counts at once; a larger one when further readings agree; of a sensor that is "
        "found to scatter by more than 0.1 K this, max_change_degc and agree_within_degc are up to 2.5 times as wide",
    )
    max_change_degc: float = Field(
        1.0, gt=0, description="a larger change from the last accepted value within one cycle is rejected"
    )
    max_rate_degc_per_min: float = Field(
        6.0, gt=0, description="after a gap the allowed change grows by this much per minute of it"
    )
    max_gap_change_degc: float = Field(
        5.0, gt=0, description="the largest change that is allowed after a gap, however long it was"
    )
    release_after_samples: int = Field(
        3,
        ge=2,
        description="a first value, a value after a gap and a rejected level count after so many samples that agree",
    )
    far_level_after_samples: int = Field(
        9, ge=2, description="the same for a level farther from the last accepted value than a gap explains"
    )
    agree_within_degc: float = Field(
        0.5, gt=0, description="what 'agree' means: with the sample before, or with the line that leads there"
    )
    min_degc: float = Field(-20.0, description="lower values are impossible here")
    max_degc: float = Field(100.0, description="higher values are impossible here")
    stale_after_s: Seconds = Field(
        60.0, description="a held value older than this, and than 2.5 cycle periods, is missing, and begins anew"
    )

    @checked
    def _ordered(self) -> Problems:
        if self.min_degc >= self.max_degc:
            yield ("min_degc",), "min_degc must be below max_degc"
        elif self.far_level_after_samples < self.release_after_samples:
            sentence = f"must not be below release_after_samples ({self.release_after_samples})"
            yield ("far_level_after_samples",), sentence


TemperatureInput = LineConfig | SourceConfig
"""A line or a source: what brings a cycle of temperatures again and again."""


class TemperaturesConfig(Section):
    """Temperature sensors, the lines that they are connected to, and other sources."""

    lines: list[LineConfig] = Field(
        default_factory=list[LineConfig], description="LATSIS lines", examples=[[{"profile": "checked"}]]
    )
    sensors: list[SensorConfig] = Field(
        default_factory=list[SensorConfig],
        description="the sensors on the lines, in the machine's order",
        examples=[
            [
                {"id": 1, "component": "Spindle unit", "label": "Nose"},
                {"id": 2, "component": "Spindle unit", "part": "Housing", "label": "Nose"},
                {"id": 3, "component": "Column", "part": "Front"},
                {"id": 4, "component": "Ambient", "label": "Room"},
            ]
        ],
    )
    sources: list[SourceConfig] | None = Field(
        None,
        description="other sources with their own sensors, beside the lines or instead of them",
        examples=[[{"driver": "modbus", "modbus": {"host": "192.168.10.30"}}]],
    )
    cleansing: CleansingConfig = Field(default_factory=CleansingConfig, description="which temperatures count")

    @checked
    def _consistent(self) -> Problems:
        yield from (*self._repeated_names(), *self._repeated_sensors(), *self._chain_problems())
        if not self.inputs:
            sentence = "there is nothing to read: describe a LATSIS line here, or another source under `sources`"
            yield ("lines",), sentence
        yield from (*self._shared_ports(), *self._wider_ranges())

    @property
    def _places(self) -> list[KeyPath]:
        """Where each line and source stands."""
        lines: list[KeyPath] = [("lines", index) for index in range(len(self.lines))]
        return [*lines, *(("sources", index) for index in range(len(self.sources or ())))]

    def _repeated_names(self) -> Problems:
        names, places = [each.name for each in self.inputs], self._places
        for index, name in repeated(names):
            at, first = places[index], places[names.index(name)]
            yield (*at, "name"), f"two {at[0] if at[0] == first[0] else 'inputs'} have the same name {name!r}"

    def _shared_ports(self) -> Problems:
        """Yield which ports two lines, two sources, or a line and a source would open."""
        ports = {line.port: line.name for line in reversed(self.lines)}
        for index, port in repeated(line.port for line in self.lines):
            yield ("lines", index, "port"), f"another line uses the port {port}"
        for index, source in enumerate(self.sources or ()):
            if (exclusive := source.connection.exclusive) is None:
                continue
            key, port = exclusive
            if (other := ports.setdefault(port, source.name)) != source.name:
                at: KeyPath = ("sources", index, source.driver, key)
                yield at, f"{other} uses {port} already; put what hangs on one bus into one source"

    def _wider_ranges(self) -> Problems:
        """Yield which sensors of sources claim a range that cleansing would refuse all the same."""
        lowest, highest = self.cleansing.min_degc, self.cleansing.max_degc
        for index, source in enumerate(self.sources or ()):
            for place, sensor in enumerate(source.sensors):
                at: KeyPath = ("sources", index, source.driver, "sensors", place)
                if sensor.min_degc is not None and sensor.min_degc < lowest:
                    sentence = (
                        f"is below cleansing.min_degc ({lowest:g}), which refuses such values: lower that as well"
                    )
                    yield (*at, "min_degc"), sentence
                if sensor.max_degc is not None and sensor.max_degc > highest:
                    sentence = (
                        f"is above cleansing.max_degc ({highest:g}), which refuses such values: raise that as well"
                    )
                    yield (*at, "max_degc"), sentence

    def _repeated_sensors(self) -> Problems:
        places: list[tuple[KeyPath, int]] = [(("sensors", i), each.id) for i, each in enumerate(self.sensors)]
        for index, source in enumerate(self.sources or ()):
            places += [
                (("sources", index, source.driver, "sensors", i), each.id) for i, each in enumerate(source.sensors)
            ]
        for index, sensor_id in repeated(sensor_id for _, sensor_id in places):
            yield (*places[index][0], "id"), f"sensor {sensor_id} is listed twice"

    def _chain_problems(self) -> Problems:
        known = {sensor.id for sensor in self.sensors}
        chained: set[int] = set()
        for index, line in enumerate(self.lines):
            at: KeyPath = ("lines", index, "chain")
            if twice := sorted({i for i in line.sensor_ids if i in chained or line.sensor_ids.count(i) > 1}):
                yield at, f"sensors on two chain positions: {twice}"
            if missing := sorted(set(line.sensor_ids) - known):
                yield at, f"the chain names sensors that are not listed: {missing}"
            chained |= set(line.sensor_ids)
        for index, sensor in enumerate(self.sensors):
            if sensor.id not in chained:
                yield ("sensors", index, "id"), f"sensor {sensor.id} hangs on no chain"

    @cached_property
    def inputs(self) -> tuple[TemperatureInput, ...]:
        """Lines and sources: each brings cycles under its name."""
        return (*self.lines, *(self.sources or ()))

    @property
    def shortest_period_s(self) -> float:
        """Cycle period of the input that is read most often [s]."""
        return min(each.cycle_period_s for each in self.inputs)

    @cached_property
    def every_sensor(self) -> tuple[SensorConfig | SourceSensorConfig, ...]:
        """The sensors of the lines and of the sources, in the machine's order."""
        return (*self.sensors, *(sensor for source in self.sources or () for sensor in source.sensors))

    @cached_property
    def sensor_ids(self) -> tuple[int, ...]:
        """Sensor IDs in the machine's order."""
        return tuple(sensor.id for sensor in self.every_sensor)

    @cached_property
    def labels(self) -> dict[str, tuple[int, ...]]:
        """Indices into the machine's sensor order by label."""
        labels: dict[str, list[int]] = {}
        for index, sensor in enumerate(self.every_sensor):
            if sensor.label:
                labels.setdefault(sensor.label, []).append(index)
        return {label: tuple(indices) for label, indices in labels.items()}

    @cached_property
    def steps_k(self) -> dict[int, float]:
        """Step in which each sensor counts [K], by its ID; 0 where it is not known."""
        return {sensor.id: sensor.step_k for sensor in self.every_sensor}

    @cached_property
    def components(self) -> tuple[str, ...]:
        """Component of each sensor in the machine's order."""
        return tuple(sensor.component for sensor in self.every_sensor)

    @cached_property
    def reads(self) -> dict[int, str]:
        """What each sensor reads, by its ID in the machine's order: from where, and how it becomes a temperature."""
        where: dict[int, str] = {}
        for line in self.lines:
            where |= {i: f"{line.port} {line.id_offset + place}" for place, i in enumerate(line.sensor_ids)}
        for source in self.sources or ():
            connection = source.connection
            over = connection.model_dump_json(exclude=HOW | {connection.listed: True}, exclude_defaults=True)
            where |= dict.fromkeys(source.sensor_ids, over)
        texts = {
            each.id: where[each.id] + each.model_dump_json(exclude=SAID, exclude_defaults=True)
            for each in self.every_sensor
        }
        return {sensor_id: hashlib.sha256(text.encode()).hexdigest()[:16] for sensor_id, text in texts.items()}
