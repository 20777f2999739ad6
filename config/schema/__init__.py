"""The one schema: every configuration key of the daemon, with its unit, bounds, default and meaning."""

from pydantic import Field

from config.schema.base import KeyPath, MachineName, Problems, Section, checked, repeated
from config.schema.cnc import CncConfig
from config.schema.compensation import CompensationConfig
from config.schema.displacements import DisplacementsConfig
from config.schema.guard import PROGRAM_LABELS
from config.schema.service import HistoryConfig, OpcUaServerConfig, ServiceConfig, ShdrConfig, SignaturesConfig
from config.schema.sinks import SinkConfig
from config.schema.spindle_speed import SpindleSpeedConfig
from config.schema.temperatures import TemperaturesConfig


class Configuration(Section):
    """Configuration of the daemon for one machine tool."""

    machine: MachineName = Field(
        description="name of the machine; a commissioning record of another permits nothing, a model that was trained "
        "on another needs a person's word",
        examples=["my machining centre"],
    )
    temperatures: TemperaturesConfig = Field(description="LATSIS lines and sensors")
    displacements: DisplacementsConfig | None = Field(
        None, description="displacement sensors; none: the machine has none"
    )
    cnc: CncConfig = Field(description="the CNC", examples=[{"opcua": {}}])
    compensation: CompensationConfig = Field(description="what may move the machine")
    spindle_speed: SpindleSpeedConfig | None = Field(
        None, description="the spindle speed follows the stability pockets; none: off"
    )
    history: HistoryConfig = Field(default_factory=HistoryConfig, description="the store")
    service: ServiceConfig = Field(default_factory=ServiceConfig, description="socket, monitor, metrics, log, retry")
    opcua_server: OpcUaServerConfig | None = Field(
        None, description="tags and methods over OPC UA for others; none: not served"
    )
    shdr: ShdrConfig | None = Field(None, description="temperatures and state for an MTConnect agent; none: not served")
    sinks: list[SinkConfig] | None = Field(
        None, min_length=1, description="systems of others to which the history goes (`toolpoint sink run`); none: off"
    )
    signatures: SignaturesConfig = Field(default_factory=SignaturesConfig, description="whose signatures count")

    @checked
    def _cross_check(self) -> Problems:
        axes, valued = set(self.compensation.axes), set(self.cnc.macros.values)
        if axes != valued:
            sentence = (
                f"compensation.axes {sorted(axes)} and cnc.macros.values {sorted(valued)} must name the same axes"
            )
            yield ("cnc", "macros", "values"), sentence
        labels = set(self.temperatures.labels)
        for name, axis in self.compensation.axes.items():
            if axis.tool_term and (unknown := sorted(set(axis.tool_term.temperatures) - labels)):
                at: KeyPath = ("compensation", "axes", name, "tool_term", "temperatures")
                yield at, f"no sensor carries the label {unknown}; there are {sorted(labels)}"
            if axis.tool_term and self.cnc.tells_prepared_tool and self.cnc.macros.request is None:
                at = ("compensation", "axes", name, "tool_term")
                sentence = (
                    "needs the tool in the spindle, and #4120 is the latest T word, which may only prepare one: add "
                    "cnc.macros.request, by which programs name their tools, or set cnc.focas.tool_macro"
                )
                yield at, sentence
        shown = self.cnc.temperature_macro
        if shown is not None and shown.sensor not in self.temperatures.sensor_ids:
            at = ("cnc", "temperature_macro", "sensor")
            yield at, f"there is no sensor {shown.sensor} (temperatures.sensors, temperatures.sources)"
        yield from self._displacement_wires()
        yield from self._numbers_of_the_guard()
        valid_s = self.compensation.output.validity_s + self.cnc.poll_period_s
        if valid_s >= (believed_s := self.cnc.guard.max_validity_s):
            sentence = (
                f"with cnc.poll_period_s a block is valid for up to {valid_s:g} s, and the guard accepts none that is "
                f"valid for {believed_s:g} s or longer (cnc.guard.max_validity_s): it would never move anything"
            )
            yield ("compensation", "output", "validity_s"), sentence
        yield from self._speed_macros()
        yield from self._positionings()
        yield from self._slopes()
        for index, name in repeated(sink.name for sink in self.sinks or ()):
            yield ("sinks", index, "name"), f"another sink is called {name} already"
        if self.opcua_server is not None and self.service.users is None:
            sentence = "is required with opcua_server: nobody could log in (`toolpoint users add NAME` makes the file)"
            yield ("service", "users"), sentence

    @property
    def reads(self) -> dict[int, str]:
        """What each sensor reads, by its ID, and of which machine: what a history holds of another is no past of it."""
        return {i: read + " of " + self.machine for i, read in self.temperatures.reads.items()}

    @property
    def other_reads(self) -> dict[str, str]:
        """What is read beside temperatures: from the control, and of each displacement."""
        return self.cnc.reads | ({} if self.displacements is None else self.displacements.reads)

    def _displacement_wires(self) -> Problems:
        """Yield which channels belong to no axis, and which sources of displacements take a port that is taken."""
        if (displacements := self.displacements) is None:
            return
        axes = sorted(set(self.compensation.axes) - set(self.compensation.slopes))
        for at, channel in displacements.placed_channels:
            if channel.axis is not None and channel.axis not in axes:
                yield ("displacements", *at, "axis"), f"there is no axis {channel.axis}; there are {', '.join(axes)}"
        ports = {line.port: line.name for line in self.temperatures.lines}
        names = {each.name for each in self.temperatures.inputs}
        for source in self.temperatures.sources or ():
            if source.connection.exclusive is not None:
                ports[source.connection.exclusive[1]] = source.name
        for index, entry in enumerate(displacements.sources or ()):
            if entry.name in names:
                yield ("displacements", "sources", index, "name"), f"temperatures come from {entry.name} already"
            if (exclusive := entry.connection.exclusive) is None:
                continue
            key, port = exclusive
            if (other := ports.setdefault(port, entry.name)) != entry.name:
                yield ("displacements", "sources", index, entry.driver, key), f"{other} uses {port} already"

    def _speed_macros(self) -> Problems:
        """Yield what is wrong with the macros of the spindle speed beside those of the compensation."""
        if self.spindle_speed is None:
            return
        cnc, macros = self.cnc, self.spindle_speed.macros
        taken = {*cnc.macros.block, *self.guard_memory}
        taken |= {cnc.temperature_macro.macro} if cnc.temperature_macro is not None else set()
        for key, number in macros.model_dump(exclude_none=True).items():
            at: KeyPath = ("spindle_speed", "macros", key)
            if number in taken:
                yield at, f"#{number} belongs to the compensation, the guard or the temperature already"
            elif number in macros.ours and number not in cnc.macros.allowed:
                yield at, f"#{number} lies outside `writable` ({', '.join(cnc.macros.writable)})"

    def _slopes(self) -> Problems:
        """Yield which slopes this control cannot take."""
        for name in self.compensation.slopes:
            if not self.cnc.takes_slopes:
                sentence = (
                    "only a SINUMERIK, a FANUC and LinuxCNC take a slope (cnc.driver opcua, focas, linuxcnc): this "
                    f"control gets offsets alone, so take {name} out of compensation.axes and cnc.macros"
                )
                yield ("compensation", "axes", name, "slope"), sentence
            if name in self.cnc.guard.axes:
                yield ("cnc", "guard", "axes", name), "a slope acts on the axis that its `slope.of` names; take it out"
        memory, macros = self.guard_memory, self.cnc.macros
        taken = {*macros.block, *macros.allowed}
        if self.compensation.slopes and (memory[-1] > 999 or not taken.isdisjoint(memory)):
            sentence = (
                f"with the places of {len(self.compensation.slopes)} slopes it needs #{memory[0]} to #{memory[-1]}: up "
                "to #999, and outside the macro map and `writable`"
            )
            yield ("cnc", "guard", "memory"), sentence

    @property
    def guard_memory(self) -> range:
        """Macros that the guard alone writes."""
        return self.cnc.guard.memory_of(len(self.cnc.macros.values), len(self.compensation.slopes))

    def _positionings(self) -> Problems:
        """Yield what is wrong with how positionings are seen."""
        reference, period_s = self.compensation.reference, self.cnc.poll_period_s
        if reference.positioning_dwell_s is not None and reference.positioning_dwell_s <= period_s:
            yield (
                ("compensation", "reference", "positioning_dwell_s"),
                f"must be longer than cnc.poll_period_s ({period_s:g} s), or a positioning passes between two polls",
            )
        macros = self.cnc.macros
        for key in ("positioning_counter", "tool_counter"):
            if (number := getattr(reference, key)) is None:
                continue
            if number in {*macros.block, *macros.allowed}:
                sentence = f"#{number} is one of the daemon's own macros; only the NC program may write it"
                yield (("compensation", "reference", key), sentence)
            elif self.cnc.driver == "linuxcnc":
                sentence = (
                    f"#{number} has no pin of LinuxCNC, so it would never count: let the program ask and name its "
                )
                yield (("compensation", "reference", key), sentence + "tools by the handshake (cnc.macros.request)")

    def _numbers_of_the_guard(self) -> Problems:
        """Yield which N numbers with a meaning also occur in the NC programs that `toolpoint guard` prints."""
        reference, output = self.compensation.reference, self.compensation.output
        lists: dict[KeyPath, list[int]] = {
            ("reference", "sequence_numbers"): reference.sequence_numbers,
            ("reference", "retreat_sequence_numbers"): reference.retreat_sequence_numbers,
            ("output", "safe_sequence_numbers"): output.safe_sequence_numbers,
        }
        for key, numbers in lists.items():
            for place, number in enumerate(numbers):
                if number in PROGRAM_LABELS:
                    sentence = (
                        f"N{PROGRAM_LABELS.start} to N{PROGRAM_LABELS.stop - 1} occur in the guard and its programs, "
                        "which pass them at every call; choose another number"
                    )
                    yield ("compensation", *key, place), sentence


__all__ = ["Configuration"]
