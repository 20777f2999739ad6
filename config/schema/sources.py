"""Sources of temperatures and displacements: what every one of them has, whatever it is read with.

To add a kind: its wire (a `SourceConnection`), its sections with sensors and with channels, its name in the `driver` of
`SourceConfig` and `DisplacementSourceConfig` with the field of that name, and one line in `drivers/registry.py`.
"""

import math
from abc import abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar, Literal

from pydantic import Field

from config.schema.base import Name, Problems, Section, checked

DEGF_PER_K = 1.8
DEGF_AT_0_DEGC = 32.0
KELVIN_AT_0_DEGC = 273.15
ABSOLUTE_ZERO_DEGC = -273.15
HOTTEST_DEGC = 2000.0
"""No sensor of a machine tool is hotter; cleansing has limits of its own."""


class Measured(Section):
    """What one input of a source measures: a sensor of temperatures, or a channel of displacements."""

    unit_words: ClassVar[str]
    """Unit of the value."""

    @property
    @abstractmethod
    def key(self) -> int | str:
        """What tells it from the other inputs of its source."""

    @property
    @abstractmethod
    def in_words(self) -> str:
        """What it is, for a sentence."""

    @property
    @abstractmethod
    def span(self) -> tuple[float, float]:
        """Lowest and highest possible value."""

    @abstractmethod
    def is_open(self, number: float) -> bool:
        """Return whether a number as read says that nothing is measured."""

    @abstractmethod
    def value(self, number: float) -> float:
        """Return the value of a number as read."""

    @abstractmethod
    def number(self, value: float) -> float:
        """Return what is read at a value; NaN at one that is none."""


class SourceSensorConfig(Measured):
    """One temperature sensor of a source: where it sits, and how its number becomes a temperature."""

    id: int = Field(ge=1, le=99_999_999, description="sensor ID of the machine's documentation", examples=[401])
    component: str = Field(min_length=1, description="machine component it sits on", examples=["Spindle unit"])
    part: str = Field("-", description="part of the component; '-': the whole of it")
    label: Name | None = Field(
        None, description="sensors with one label are averaged under that name", examples=["Housing"]
    )
    unit: Literal["degC", "degF", "K"] = Field("degC", description="unit of the number after scale and offset")
    scale: float = Field(1.0, description="the number read is multiplied by this: 0.1 where 235 means 23.5")
    offset: float = Field(0.0, description="then this is added, in the unit")
    open: list[float] = Field(
        default_factory=list, description="numbers as read that say that the sensor is open, shorted or absent"
    )
    resolution: float = Field(
        0.0, ge=0, description="step of the temperature in the unit, where what sends it rounds: 0.5; 0: not known"
    )
    min_degc: float | None = Field(
        None,
        description="lower values are impossible for this sensor; left out: `cleansing.min_degc`",
        examples=[-10.0],
    )
    max_degc: float | None = Field(
        None,
        description="higher values are impossible for this sensor; left out: `cleansing.max_degc`",
        examples=[90.0],
    )

    unit_words: ClassVar[str] = "degC"

    @checked
    def _readable(self) -> Problems:
        if self.scale == 0:
            yield ("scale",), "must not be 0, or the temperature is always the same"
        if self.min_degc is not None and self.max_degc is not None and self.min_degc >= self.max_degc:
            yield ("min_degc",), "min_degc must be below max_degc"

    @property
    def key(self) -> int:
        return self.id

    @property
    def in_words(self) -> str:
        """Its ID with where it sits."""
        place = self.component if self.part == "-" else f"{self.component}, {self.part}"
        return f"sensor {self.id} ({place})"

    @property
    def span(self) -> tuple[float, float]:
        """Lowest and highest possible temperature [degC]."""
        lowest = ABSOLUTE_ZERO_DEGC if self.min_degc is None else self.min_degc
        return lowest, HOTTEST_DEGC if self.max_degc is None else self.max_degc

    def is_open(self, number: float) -> bool:
        return number in self.open

    @property
    def step_k(self) -> float:
        """Step in which it counts [K]; 0 where it is not known."""
        return self.resolution / DEGF_PER_K if self.unit == "degF" else self.resolution

    def value(self, number: float) -> float:
        """Return the temperature of a number as read [degC]."""
        value = number * self.scale + self.offset
        if self.unit == "K":
            return value - KELVIN_AT_0_DEGC
        return (value - DEGF_AT_0_DEGC) / DEGF_PER_K if self.unit == "degF" else value

    def number(self, value: float) -> float:
        """Return what is read at a temperature [degC]; NaN at one that is none."""
        shown = value if self.unit == "degC" else value + KELVIN_AT_0_DEGC
        shown = value * DEGF_PER_K + DEGF_AT_0_DEGC if self.unit == "degF" else shown
        return (shown - self.offset) / self.scale if math.isfinite(shown) else math.nan


class SourceConnection(Section):
    """What every driver's section answers for itself, so that no other part has to know the driver."""

    driver: ClassVar[str]
    """Name of the driver, which is also the key of the section."""
    listed: ClassVar[str] = "sensors"
    """Key of the list of its inputs."""

    @property
    def every_input(self) -> Sequence[Any]:
        """Its sensors or channels, in the order of the section."""
        inputs: Sequence[Any] = getattr(self, self.listed)
        return inputs

    @property
    def exclusive(self) -> tuple[str, str] | None:
        """Key and name of what no other source or line may use as well, such as a serial port."""
        return None

    @property
    def exposed(self) -> str:
        """How others on a network could read or change the values; '' where they cannot."""
        return ""

    @property
    def secrets(self) -> dict[str, Path]:
        """Files with passwords and keys by their keys in the section: not shown, and in no back-up."""
        return {}
