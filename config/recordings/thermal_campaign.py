"""The programme of a thermal measurement campaign: which operations follow each other, and which are numbered."""

from collections import Counter
from itertools import cycle
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from config.loader import load_yaml_model
from config.schema.base import KeyPath, Problems, Section, checked

PUBLISHED = Path(__file__).parent / "table_3_1.yaml"
"""The dissertation's programme, as it ships."""

WholeMinutes = Annotated[int, Field(ge=1, le=1440)]
Speed = Annotated[float, Field(ge=0.0, le=1e6)]


class Switching(Section):
    """Short rotations and stops: the two lists are gone through side by side until the operation is over."""

    rotation_min: list[WholeMinutes] = Field(min_length=1, description="durations of rotation [min]")
    idle_min: list[WholeMinutes] = Field(min_length=1, description="durations of standstill [min]")


class Operation(Section):
    """One operation of the campaign."""

    dataset: int | None = Field(None, ge=1, le=999, description="its number; none when it only precedes another")
    speeds_rpm: list[Speed] = Field(min_length=1, description="spindle speeds, one after the other [1/min]")
    minutes_each: WholeMinutes = Field(120, description="rotation at each speed [min]")
    switching: Switching | None = Field(None, description="rotation and standstill in turn instead")
    idle_reduction: bool = Field(False, description="the chiller stops while the spindle stands still")
    previous: str = Field("", description="what went before, in the table's words")
    cooling: str = Field("", description="operation of the cooling system, in the table's words")
    usage: Literal["train", "test", ""] = Field("", description="what the data set is for")

    def phases(self, minutes: int) -> list["Phase"]:
        """Return what the machine does during the operation."""
        found: list[Phase] = []
        if self.switching is None:
            found = [Phase(minutes=self.minutes_each, speed_rpm=speed, chiller=True) for speed in self.speeds_rpm]
        else:
            pairs = zip(cycle(self.switching.rotation_min), cycle(self.switching.idle_min), strict=False)
            for turning, resting in pairs:
                found.append(Phase(minutes=turning, speed_rpm=self.speeds_rpm[0], chiller=True))
                found.append(Phase(minutes=resting, speed_rpm=0.0, chiller=not self.idle_reduction))
                if sum(phase.minutes for phase in found) >= minutes:
                    break
        rest = minutes - sum(phase.minutes for phase in found)
        if rest > 0:
            found.append(Phase(minutes=rest, speed_rpm=0.0, chiller=not self.idle_reduction))
        return found


class Phase(Section):
    """A stretch of constant spindle speed."""

    minutes: int
    speed_rpm: float
    chiller: bool


class Series(Section):
    """Operations that follow each other without a break, on a machine that was cold at the beginning."""

    start_day: float = Field(0.0, ge=0.0, le=365.0, description="when it begins [days since the campaign's beginning]")
    operations: list[Operation] = Field(min_length=1)


class ThermalCampaign(Section):
    """A measurement campaign."""

    name: str = Field(min_length=1)
    minutes: WholeMinutes = Field(description="length of an operation [min]")
    reference_minutes: WholeMinutes = Field(1, description="standstill before each series [min]")
    series: list[Series] = Field(min_length=1)

    @checked
    def _check(self) -> Problems:
        numbers = Counter(operation.dataset for series in self.series for operation in series.operations)
        ends_day = 0.0
        for place, series in enumerate(self.series):
            if series.start_day < ends_day:
                yield ("series", place, "start_day"), f"the series before only ends on day {ends_day:.3g}"
            minutes = self.reference_minutes + self.minutes * len(series.operations)
            ends_day = series.start_day + minutes / 1440.0
            for index, operation in enumerate(series.operations):
                key: KeyPath = ("series", place, "operations", index)
                if operation.dataset is not None and numbers[operation.dataset] > 1:
                    yield (*key, "dataset"), f"data set {operation.dataset} stands here more than once"
                used = sum(phase.minutes for phase in operation.phases(self.minutes))
                if used != self.minutes:
                    yield key, f"takes {used} min where an operation has {self.minutes}"

    @property
    def datasets(self) -> dict[int, Operation]:
        """The numbered operations, by number."""
        numbered = {o.dataset: o for series in self.series for o in series.operations if o.dataset is not None}
        return dict(sorted(numbered.items()))


def load_thermal_campaign(path: Path = PUBLISHED) -> ThermalCampaign:
    """Read a campaign; raises `ConfigurationError` with file, line, column and key of everything wrong."""
    return load_yaml_model(path, ThermalCampaign)
