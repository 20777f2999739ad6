"""What a device of an agent tells: which of its data items mean what, and their latest observations."""

import math
import re
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

from config.schema.cnc import AxisPositionConfig, CncConfig
from config.schema.cnc_drivers import MtconnectConfig
from drivers.contract import Capability, FatalDriverError
from drivers.mtconnect.xml import Element, XmlError
from models.records import CncMode, CncRun

UNAVAILABLE = "UNAVAILABLE"
RUNS = {
    "ACTIVE": CncRun.START,
    "WAIT": CncRun.START,
    "FEED_HOLD": CncRun.HOLD,
    "INTERRUPTED": CncRun.HOLD,
    "OPTIONAL_STOP": CncRun.STOP,
    "PROGRAM_STOPPED": CncRun.STOP,
    "STOPPED": CncRun.STOP,
    "PROGRAM_OPTIONAL_STOP": CncRun.STOP,
    "PROGRAM_COMPLETED": CncRun.RESET,
    "READY": CncRun.RESET,
}
"""EXECUTION of an agent -> state of the program."""
MODES = {
    "AUTOMATIC": CncMode.MEMORY,
    "SEMI_AUTOMATIC": CncMode.MEMORY,
    "MANUAL": CncMode.JOG,
    "MANUAL_DATA_INPUT": CncMode.MDI,
    "EDIT": CncMode.EDIT,
}
BLOCK_NUMBER = re.compile(r"^\s*/?\s*N(\d{1,8})", re.IGNORECASE)
PROGRAM_NUMBER = re.compile(r"^O?0*(\d{1,8})(\.\w{1,4})?$", re.IGNORECASE)
WORK_OFFSET = re.compile(r"^G?(\d{1,6})(?:\.1\s*P(\d{1,3}))?$", re.IGNORECASE)
PLAIN = ("", "EVENT", "SAMPLE", "VALUE", "DISCRETE")
"""Categories and representations of what is observed as it is."""
ACTUAL_POSITIONS = ("", "ACTUAL", "COMMANDED")
SPEEDS = ("ROTARY_VELOCITY", "SPINDLE_SPEED")
ITEMS: dict[str, tuple[tuple[str, str], ...]] = {
    "execution": (("EXECUTION", ""),),
    "mode": (("CONTROLLER_MODE", ""),),
    Capability.PROGRAM: (("PROGRAM", "ACTIVE"), ("PROGRAM", "MAIN"), ("PROGRAM", "")),
    "label": (("LINE_LABEL", ""),),
    "block": (("BLOCK", ""),),
    Capability.SPINDLE_SPEED: tuple((kind, subtype) for subtype in ("ACTUAL", "") for kind in SPEEDS),
    Capability.WORK_OFFSET: (("WORK_OFFSET", ""),),
    Capability.TOOL_NUMBER: (("TOOL_NUMBER", ""), ("TOOL_ID", "")),
}
"""What the daemon knows -> types and subtypes of data items that tell it, the best first; '' is none: what is
commanded, overridden or scheduled is not what is."""
UNITS: dict[str, str] = {Capability.SPINDLE_SPEED: "REVOLUTION/MINUTE", Capability.MOTOR_TEMPERATURE: "CELSIUS"}
"""Of what has one; an item that tells none has it."""
READS_ONLY = "an MTConnect agent is read and never written: reach the control by another driver to compensate"
NO_ITEM = "the agent's device has no data item of type {}"
NAME_SPINDLE = "name the spindle's in cnc.mtconnect.spindle_speed_item"
NOT_TOLD = "MTConnect does not tell it"


MOST_FAULTS = 1000
"""Of one condition at a time."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DataItem:
    item_id: str
    name: str
    kind: str
    """Its type; further words where it tells no present value: a statistic, a condition, a series or a table."""
    subtype: str
    unit: str = ""
    coordinates: str = ""


@dataclass
class Device:
    """One device, its data items, and what was observed last."""

    name: str
    uuid: str
    items: tuple[DataItem, ...]
    spindle_item: str | None = None
    motor_item: str | None = None
    axes: Mapping[str, tuple[AxisPositionConfig, str | None]] = field(default_factory=dict)
    """Axis positions by their names: the axis, and the id or name of its data item."""
    values: dict[str, str] = field(default_factory=dict)
    """Text of the latest observation by data item."""
    faults: dict[str, set[str]] = field(default_factory=dict)
    """Ids or native codes of the faults that are active, by data item of a condition."""
    cannot: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Choose the data items; raises FatalDriverError where one that is needed or named is missing."""
        self.cannot = {Capability.READ_MACROS: READS_ONLY, Capability.WRITE_MACROS: READS_ONLY}
        self._chosen = {role: self._choose(role, kinds) for role, kinds in ITEMS.items()}
        for role, item in (
            (Capability.SPINDLE_SPEED, self.spindle_item),
            (Capability.MOTOR_TEMPERATURE, self.motor_item),
        ):
            if item is not None:
                self._chosen[role] = self._measured(role, self._named(item))
        if self._chosen["execution"] is None:
            sentence = "nothing says whether a program runs; choose another device (cnc.mtconnect.device)"
            raise FatalDriverError(f"the agent's device {self.name} has no data item of type EXECUTION: {sentence}")
        self._emergency_stops = [item.item_id for item in self.items if item.kind == "EMERGENCY_STOP"]
        self._known = {item.item_id for item in self.items}
        self.cannot |= {Capability.CLOCK: NOT_TOLD, Capability.POWER_ON_COUNT: NOT_TOLD}
        for role in (Capability.PROGRAM, Capability.SPINDLE_SPEED, Capability.WORK_OFFSET, Capability.TOOL_NUMBER):
            if self._chosen[role] is None:
                self.cannot.setdefault(role, NO_ITEM.format(ITEMS[role][0][0]))
        if self._chosen["label"] is None and self._chosen["block"] is None:
            self.cannot[Capability.SEQUENCE_NUMBER] = NO_ITEM.format("LINE_LABEL or BLOCK")
        if self._chosen.get(Capability.MOTOR_TEMPERATURE) is None:
            why = "no data item is named in cnc.mtconnect.motor_temperature_item"
            self.cannot.setdefault(Capability.MOTOR_TEMPERATURE, why)
        for name, (axis, item) in self.axes.items():
            self._choose_position(name, axis, item)

    def _choose_position(self, name: str, axis: AxisPositionConfig, item: str | None) -> None:
        """Take the data item of an axis position, or say why it tells none."""
        why = ""
        if item is None:
            why = f"no data item is named for {axis.axis} in cnc.mtconnect.position_items"
        else:
            found = self._named(item)
            if found.unit != "MILLIMETER":
                why = f"data item {item} of {axis.axis} is in {found.unit or 'no unit'}, not in MILLIMETER"
            elif found.coordinates == "WORK" or found.subtype not in ACTUAL_POSITIONS:
                why = f"data item {item} of {axis.axis} is no actual position in coordinateSystem MACHINE"
            else:
                self._chosen[f"position {name}"] = found.item_id
        if why:
            self.cannot.setdefault(Capability.AXIS_POSITION, why)

    def positions_mm(self) -> dict[str, float]:
        """Return the position of each axis [mm], NaN where it is not told now."""
        return {name: self.number(f"position {name}") for name in self.axes}

    def _choose(self, role: str, kinds: tuple[tuple[str, str], ...]) -> str | None:
        for kind, subtype in kinds:
            found = [item for item in self.items if (item.kind, item.subtype) == (kind, subtype)]
            if len(found) > 1 and role == Capability.SPINDLE_SPEED:
                names = ", ".join(item.name or item.item_id for item in found)
                self.cannot[role] = f"the device has {len(found)} data items of {kind} ({names}): {NAME_SPINDLE}"
                return None
            if found:
                return self._measured(role, found[0])
        return None

    def _measured(self, role: str, item: DataItem) -> str | None:
        """Return the id of an item in the unit of what it tells; None, and the reason, for one in another."""
        unit = UNITS.get(role, item.unit)
        if item.unit not in ("", unit):
            self.cannot[role] = f"data item {item.name or item.item_id} is in {item.unit}, not in {unit}"
            return None
        self.cannot.pop(role, None)
        return item.item_id

    def _named(self, name: str) -> DataItem:
        found = next((item for item in self.items if name in (item.item_id, item.name)), None)
        if found is None:
            raise FatalDriverError(
                f"the agent's device {self.name} has no data item {name!r}; its probe page shows their ids and names"
            )
        return found

    # --- observations --------------------------------------------------------------------

    def observe(self, streams: Element, *, anew: bool) -> None:
        """Take the observations of an answer in their order; `anew`: nothing else is true any more. Raises XmlError."""
        if anew:
            self.values.clear()
            self.faults.clear()
        for stream in streams.below("DeviceStream"):
            if (uuid := stream.attributes.get("uuid", self.uuid)) == self.uuid:
                for component in stream.below("ComponentStream"):
                    self._take(component)
            elif stream.attributes.get("name") == self.name:
                raise XmlError(f"its device {self.name} has the uuid {uuid} now, and no longer {self.uuid}")

    def _take(self, component: Element) -> None:
        for part in component.children:
            for observation in part.children:
                item = observation.attributes.get("dataItemId", "")
                if item not in self._known:
                    continue  # or an agent that invents some would fill the memory
                if part.name in ("Samples", "Events"):
                    self.values[item] = observation.text.strip()
                elif part.name == "Condition":
                    self._condition(item, observation)

    def _condition(self, item: str, observation: Element) -> None:
        """Take a state of a condition: without a code, one that is normal or not known ends all its faults.

        An activation is told apart by its conditionId, before version 2.3 by its nativeCode.
        """
        told = observation.attributes
        code = told.get("conditionId") or told.get("nativeCode", "")
        active = self.faults.setdefault(item, set())
        if observation.name == "Fault":
            active.add(code)
            if len(active) > MOST_FAULTS:
                raise XmlError(f"its condition {item} has more than {MOST_FAULTS} faults at a time")
        elif observation.name in ("Normal", "Unavailable") and not code:
            active.clear()
        else:
            active.discard(code)

    def _text(self, role: str) -> str:
        """Return what was observed last, '' where nothing is known."""
        item = self._chosen.get(role)
        text = "" if item is None else self.values.get(item, "")
        return "" if text == UNAVAILABLE else text

    @property
    def run(self) -> CncRun:
        return RUNS.get(self._text("execution"), CncRun.UNKNOWN)

    @property
    def mode(self) -> CncMode:
        return MODES.get(self._text("mode"), CncMode.UNKNOWN)

    @property
    def alarm(self) -> bool:
        """A condition is a fault, or an emergency stop is pressed."""
        return any(self.faults.values()) or any(self.values.get(item) == "TRIGGERED" for item in self._emergency_stops)

    @property
    def program(self) -> int:
        """Number of the program; one that has a name gets a number made from it, 0 is none."""
        name = self._text(Capability.PROGRAM).replace("\\", "/").rpartition("/")[2]
        found = PROGRAM_NUMBER.match(name)
        if found is not None:
            return int(found[1])
        return 100_000_000 + zlib.crc32(name.encode()) % 900_000_000 if name else 0

    @property
    def sequence_number(self) -> int:
        """N of the running block, 0 where it has none."""
        label = self._text("label").lstrip("Nn")
        if label.isdecimal():
            return int(label[:8])
        found = BLOCK_NUMBER.match(self._text("block"))
        return int(found[1]) if found is not None else 0

    @property
    def work_offset(self) -> int:
        """G code of the work offset, 0 where it is not told."""
        found = WORK_OFFSET.match(self._text(Capability.WORK_OFFSET))
        if found is None:
            return 0
        return int(found[1]) if found[2] is None else int(found[1]) * 10_000 + 1000 + int(found[2])

    @property
    def tool_number(self) -> int:
        """Number of the tool in the spindle, 0 where it is not told."""
        text = self._text(Capability.TOOL_NUMBER).lstrip("Tt")
        return int(text[:8]) if text.isdecimal() else 0

    def number(self, role: str) -> float:
        """Return a sample's value, NaN where it is not known."""
        try:
            value = float(self._text(role))
        except ValueError:
            return math.nan
        return value if math.isfinite(value) else math.nan


def data_items(device: Element) -> Iterator[DataItem]:
    for item in device.below("DataItem"):
        found = item.attributes
        further = [found.get(key, "") for key in ("category", "statistic", "representation")]
        yield DataItem(
            item_id=found.get("id", ""),
            name=found.get("name", ""),
            kind=" ".join([found.get("type", ""), *(word for word in further if word not in PLAIN)]),
            subtype=found.get("subType", ""),
            unit=found.get("units", ""),
            coordinates=found.get("coordinateSystem", ""),
        )


def chosen_device(probe: Element, config: CncConfig) -> Device:
    """Return the device of the configured name or uuid, or the only one; raises FatalDriverError."""
    agent = config.connection_as(MtconnectConfig)
    wanted = agent.device
    devices = list(probe.below("Device"))
    names = ", ".join(sorted(each.attributes.get("name", "") for each in devices)) or "none"
    found = [each for each in devices if wanted in (None, each.attributes.get("name"), each.attributes.get("uuid"))]
    if len(found) != 1:
        what = f"has no device {wanted!r}" if wanted is not None else f"has {len(devices)} devices"
        raise FatalDriverError(f"the agent {what}: put one of its names into cnc.mtconnect.device; there are {names}")
    device = found[0]
    name, uuid = device.attributes.get("name", ""), device.attributes.get("uuid", "")
    return Device(
        name=name,
        uuid=uuid,
        items=tuple(data_items(device)),
        spindle_item=agent.spindle_speed_item,
        motor_item=agent.motor_temperature_item,
        axes={name: (axis, agent.position_items.get(axis.axis)) for name, axis in config.axis_positions.items()},
    )
