"""The tags: every sensor, the estimate, the compensation and the state, from the snapshots of the daemon's tasks."""

import math
import time
from collections.abc import Iterator

import numpy as np
from asyncua.ua.status_codes import StatusCodes

from config.schema import Configuration
from daemon.monitor.arrival import too_old
from daemon.snapshots import ControlSnapshot, SnapshotBoard, ThermalSnapshot
from drivers.opcua.server.encoding import NULL, Encoded, Kind, strings, variant
from drivers.opcua.server.space import (
    ANALOG,
    COMPONENT,
    FOLDER,
    OBJECT,
    ORGANIZES,
    PROPERTY,
    PROPERTY_TYPE,
    Node,
    Space,
    Variable,
)
from drivers.opcua.server.standard import unit_property
from models.quality import Quality, Reason

NAMESPACE = "urn:toolpoint:tags"
INDEX = 2
"""Its number among the namespaces of the server; the first is the server's own."""
STATUSES = {
    Reason.NOT_RECEIVED: StatusCodes.BadNoCommunication,
    Reason.DUPLICATE_ID: StatusCodes.BadCommunicationError,
    Reason.RESET: StatusCodes.BadWaitingForInitialData,
    Reason.DEVICE_ERROR: StatusCodes.BadSensorFailure,
    Reason.OUT_OF_RANGE: StatusCodes.BadOutOfRange,
    Reason.RATE: StatusCodes.BadOutOfRange,
    Reason.QUARANTINED: StatusCodes.BadOutOfService,
    Reason.STALE: StatusCodes.BadNoData,
    Reason.UNCONFIRMED: StatusCodes.BadWaitingForInitialData,
}
"""Why there is no value -> its status; a value that is held is UncertainLastUsableValue, whatever the reason."""
FRESH, NOT_YET = int(StatusCodes.Good), int(StatusCodes.BadWaitingForInitialData)
HELD, NO_VALUE = int(StatusCodes.UncertainLastUsableValue), int(StatusCodes.BadNoData)
AXIS_VALUES = {
    "estimated_um": "thermal error since the reference, as estimated",
    "requested_um": "offset that the estimate asks for",
    "written_um": "offset within the limits, read back from the macro",
    "applied_um": "offset that the guard in the NC echoed: what the machine has",
    "baseline_um": "offset that was applied when the reference was set",
}


class Tags:
    """Adds the tags to a space and brings them up to date, when somebody looks."""

    def __init__(self, configuration: Configuration, board: SnapshotBoard, space: Space, objects: Node) -> None:
        self._configuration, self._board, self._space = configuration, board, space
        machine = Node((INDEX, "machine"), configuration.machine, OBJECT, FOLDER, "machine tool of this daemon")
        self.machine = space.add(machine, objects, ORGANIZES)
        self._sensors: list[Variable] = []
        self._texts: dict[str, Variable] = {}
        self._values: dict[str, Variable] = {}
        self._channels: dict[str, tuple[Variable, Variable]] = {}
        self._thermal: ThermalSnapshot | None = None
        self._old = False
        self._control: ControlSnapshot | None = None
        self._text("state.last_refusal", self.machine, "why the latest method call was refused")

    def add_all(self) -> Iterator[None]:
        """Add the tags; yields now and then, so that the loop may turn to other work."""
        folder = self._folder("temperatures", "every temperature sensor")
        for sensor in self._configuration.temperatures.every_sensor:
            name = f"temperature.{sensor.id}"
            tag = self._number(name, folder, "°C", f"{sensor.component}, {sensor.part}")
            for key, text in (("Component", sensor.component), ("Part", sensor.part), ("Label", sensor.label or "")):
                self._fact(tag, key, text)
            self._sensors.append(tag)
            yield
        folder = self._folder("estimate", "thermal error since the reference, as the model estimates it")
        self._values["estimate.confidence"] = self._number("estimate.confidence", folder, "", "0 to 1")
        self._text("estimate.model", folder, "the model at work")
        for axis in self._configuration.compensation.axes.values():
            if axis.estimate is not None and axis.estimate not in self._channels:
                name = f"estimate.{axis.estimate}"
                unit = "µm" if axis.slope is None else "µm/m"
                self._channels[axis.estimate] = (
                    self._number(f"{name}.thermal_error_um", folder, unit, "actual minus nominal"),
                    self._number(f"{name}.band_um", folder, unit, "half width of the prediction band"),
                )
        yield
        for axis_name, axis in self._configuration.compensation.axes.items():
            pivot = self._configuration.compensation.pivot_of(axis_name)
            at = f", at {pivot['pivot_mm']:g} mm, its slope's pivot" if pivot else ""
            kind, unit = ("offset of axis", "µm") if axis.slope is None else ("slope", "µm/m")
            axis_folder = self._folder(f"compensation.{axis_name}", f"{kind} {axis_name}")
            for value, words in AXIS_VALUES.items():
                name = f"compensation.{axis_name}.{value}"
                meaning = words + at if axis.slope is None else words.replace("offset", "slope")
                self._values[name] = self._number(name, axis_folder, unit, meaning)
            for value, words in (("wanted", "a person switched it on"), ("enabled", "its enable bit is set")):
                name = f"compensation.{axis_name}.{value}"
                self._values[name] = self._add(
                    Variable((INDEX, name), name, Kind.BOOLEAN, description=words), axis_folder
                )
        folder = self._folder("state", "state of the compensation and why")
        for name, words in (
            ("state.output", "OFF, ARMED, ACTIVE, HOLD, RETREAT or FAULT"),
            ("state.reason", "why it is in this state"),
            ("state.alarm", "what a person must look at; empty: nothing"),
            ("state.phase", "what the machine is doing: idle, safe point or cutting"),
            ("state.reference", "number of the reference in force; empty: there is none"),
            ("state.reference_ended", "why there is no reference"),
        ):
            self._text(name, folder, words)
        tag = Variable((INDEX, "state.fault"), "state.fault", Kind.UINT32, description="number of the newest FAULT")
        self._texts["state.fault"] = self._add(tag, folder)
        for name, words in (("state.notices", "what a person should know"), ("state.links_down", "links, and why")):
            tag = Variable((INDEX, name), name, Kind.STRING, array=True, description=words)
            self._texts[name] = self._add(tag, folder)

    # --- what is told --------------------------------------------------------------------

    def refresh(self) -> None:
        """Bring every tag up to the latest snapshots."""
        thermal, control = self._board.thermal, self._board.control
        old = too_old(thermal, self._configuration)
        if thermal is not self._thermal or old is not self._old:
            self._thermal, self._old = thermal, old
            self._tell_temperatures(thermal)
            self._tell_estimate(thermal)
        if control is not self._control:
            self._control = control
            self._tell_control(control)

    def refuse(self, sentence: str) -> None:
        """Tell why a method call was refused: most clients show no more of it than a number."""
        self._say("state.last_refusal", variant(Kind.STRING, sentence), time.time())

    def _tell_temperatures(self, thermal: ThermalSnapshot) -> None:
        latest = thermal.temperatures
        if latest is None:
            for tag in self._sensors:
                tag.set(NULL, NOT_YET, 0.0)
            return
        arrived_s = latest.trace.last_byte.utc_s
        ages = np.where(np.isfinite(latest.age_s), latest.age_s, 0.0)
        times = np.round(arrived_s - ages, 3).tolist()
        columns = zip(
            self._sensors, latest.degc.tolist(), latest.quality.tolist(), latest.reason.tolist(), times, strict=True
        )
        for tag, degc, quality, reason, time_s in columns:
            if self._old:
                tag.set(NULL, int(STATUSES[Reason.STALE]), time_s)
            elif quality == Quality.GOOD:
                tag.set(variant(Kind.DOUBLE, degc), FRESH, time_s)
            elif quality == Quality.HELD and math.isfinite(degc):
                tag.set(variant(Kind.DOUBLE, degc), HELD, time_s)
            else:
                tag.set(NULL, int(STATUSES.get(reason, NO_VALUE)), time_s)

    def _tell_estimate(self, thermal: ThermalSnapshot) -> None:
        estimate = thermal.estimate
        if estimate is None:
            for tags in self._channels.values():
                for tag in tags:
                    tag.set(NULL, NOT_YET, 0.0)
            self._values["estimate.confidence"].set(NULL, NOT_YET, 0.0)
            return
        time_s = estimate.trace.last_byte.utc_s
        for channel, (error, band) in self._channels.items():
            known = channel in estimate.channels and not self._old
            place = estimate.channels.index(channel) if known else 0
            _tell(error, float(estimate.thermal_error_um[place]) if known else math.nan, time_s)
            _tell(band, float(estimate.band_um[place]) if known else math.nan, time_s)
        _tell(self._values["estimate.confidence"], math.nan if self._old else estimate.confidence, time_s)
        self._say("estimate.model", variant(Kind.STRING, estimate.model_id), time_s)

    def _tell_control(self, control: ControlSnapshot) -> None:
        time_s = 0.0 if control.cnc is None else control.cnc.sample.time.utc_s
        for i, axis in enumerate(control.axes):
            columns = {
                "estimated_um": control.thermal_error_um,
                "requested_um": control.requested_um,
                "written_um": control.written_um,
                "applied_um": control.applied_um,
                "baseline_um": control.baseline_um,
            }
            for value, column in columns.items():
                _tell(self._values[f"compensation.{axis}.{value}"], float(column[i]), time_s)
            for value, flags in (("wanted", control.wanted), ("enabled", control.enabled)):
                self._values[f"compensation.{axis}.{value}"].set(variant(Kind.BOOLEAN, flags[i]), FRESH, time_s)
        reference = control.reference
        texts = {
            "state.output": control.state.value,
            "state.reason": control.reason,
            "state.alarm": control.alarm,
            "state.phase": control.phase.value,
            "state.reference": "" if reference is None else reference.reference_id,
            "state.reference_ended": control.reference_ended,
        }
        for name, text in texts.items():
            self._say(name, variant(Kind.STRING, text), time_s)
        self._say("state.fault", variant(Kind.UINT32, control.fault), time_s)
        down = [f"{link.name}: {link.problem}" for link in self._board.links if not link.up]
        self._say("state.notices", strings(list(control.notices)), time_s)
        self._say("state.links_down", strings(down), time_s)

    def _say(self, name: str, value: Encoded, time_s: float) -> None:
        self._texts[name].set(value, FRESH, time_s)

    # --- nodes ---------------------------------------------------------------------------

    def _folder(self, name: str, words: str) -> Node:
        return self._space.add(Node((INDEX, name), name, OBJECT, FOLDER, words), self.machine, ORGANIZES)

    def _number(self, name: str, parent: Node, unit: str, words: str) -> Variable:
        tag = self._add(Variable((INDEX, name), name, Kind.DOUBLE, type_number=ANALOG, description=words), parent)
        if unit:
            self._space.add(unit_property((INDEX, f"{name}.EngineeringUnits"), unit), tag, PROPERTY)
        tag.status = NOT_YET
        return tag

    def _text(self, name: str, parent: Node, words: str) -> Variable:
        tag = Variable((INDEX, name), name, Kind.STRING, variant(Kind.STRING, ""), description=words)
        self._texts[name] = self._add(tag, parent)
        return tag

    def _add(self, tag: Variable, parent: Node) -> Variable:
        self._space.add(tag, parent, COMPONENT)
        return tag

    def _fact(self, tag: Node, name: str, text: str) -> None:
        value = variant(Kind.STRING, text)
        fact = Variable((INDEX, f"{tag.key[1]}.{name}"), name, Kind.STRING, value, type_number=PROPERTY_TYPE)
        self._space.add(fact, tag, PROPERTY)


def _tell(tag: Variable, value: float, time_s: float) -> None:
    known = math.isfinite(value)
    tag.set(variant(Kind.DOUBLE, value), FRESH if known else NO_VALUE, time_s)
