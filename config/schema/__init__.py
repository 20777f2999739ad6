"""The one schema: every knob of the daemon, with its unit, bounds, default and meaning."""

from pydantic import Field, model_validator

from config.schema.base import Section
from config.schema.cnc import CncConfig
from config.schema.compensation import CompensationConfig
from config.schema.displacements import DisplacementsConfig
from config.schema.service import HistoryConfig, ServiceConfig
from config.schema.temperatures import TemperaturesConfig


class Configuration(Section):
    """Configuration of the daemon for one machine tool."""

    machine: str = Field(min_length=1, description="name of the machine, for people")
    temperatures: TemperaturesConfig = Field(description="LATSIS lines and sensors")
    displacements: DisplacementsConfig | None = Field(
        None, description="displacement sensors; none: the machine has none"
    )
    cnc: CncConfig = Field(description="the CNC")
    compensation: CompensationConfig = Field(description="what may move the machine")
    history: HistoryConfig = Field(default_factory=HistoryConfig, description="the store")
    service: ServiceConfig = Field(default_factory=ServiceConfig, description="socket, metrics, log, retry")

    @model_validator(mode="after")
    def _cross_check(self) -> "Configuration":
        axes = set(self.compensation.axes)
        if axes != set(self.cnc.macros.values):
            raise ValueError(
                f"compensation.axes {sorted(axes)} and cnc.macros.values "
                f"{sorted(self.cnc.macros.values)} must name the same axes"
            )
        labels = set(self.temperatures.labels)
        for name, axis in self.compensation.axes.items():
            if axis.tool_term and (unknown := sorted(set(axis.tool_term.temperatures) - labels)):
                raise ValueError(f"compensation.axes.{name}.tool_term: no sensor carries the label {unknown}")
        return self


__all__ = ["Configuration"]
