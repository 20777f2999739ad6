"""The CNC's variables in its OPC UA address space: their node ids, and what their values mean."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from asyncua import ua
from asyncua.ua.attribute_ids import AttributeIds
from asyncua.ua.status_codes import StatusCodes
from asyncua.ua.uaerrors import UaError

from config.schema.cnc import AxisPositionConfig
from drivers.contract import MODES, RUNS, Capability, FatalDriverError, LinkError, NotSentError, position_mm
from drivers.opcua.services import DOUBLE, STRING, Answer, encode_number, encode_read, encode_target, encode_write
from models.json_values import number_in
from models.records import CncMode, CncRun, CncSample, Instant

STATE_NODES = (
    *("mode", "run", "alarm", "program", "sequence_number", "spindle_speed", "motor_temperature"),
    *("clock", "power_on_count", "work_offset", "tool_number"),
)
"""Keys of `OpcUaNodesConfig` in the order in which they are read."""
MEASURED = frozenset({"spindle_speed", "motor_temperature"})
"""Measurements: without a value they are NaN, while the others are needed to know what the machine does."""

AT_ONCE = 1000
LIMITS = (ua.NodeId(ua.Int32(11705)), ua.NodeId(ua.Int32(11707)))
"""Nodes of every server that say how many nodes it reads and writes in one request."""
BUILT_IN = frozenset(range(1, STRING + 1))
"""Types of which it is known whether they hold a number (OPC 10000-6, 5.1.2)."""
VACANT = frozenset(
    {StatusCodes.BadNoData, StatusCodes.BadNoDataAvailable, StatusCodes.BadDataUnavailable, StatusCodes.GoodNoData}
)
UNKNOWN_NODE = frozenset({StatusCodes.BadNodeIdUnknown, StatusCodes.BadNodeIdInvalid})
FORBIDDEN = frozenset({StatusCodes.BadUserAccessDenied, StatusCodes.BadNotReadable})


FANUC_NODES = {
    "mode": "s=Mode",
    "run": "s=RunState",
    "alarm": "s=Alarm",
    "program": "s=Program",
    "sequence_number": "s=SequenceNumber",
    "spindle_speed": "s=SpindleSpeed",
    "motor_temperature": "s=SpindleMotorTemperature",
    "clock": "s=Clock",
    "power_on_count": "s=PowerOnCount",
    "work_offset": "s=WorkOffset",
    "tool_number": "s=ToolNumber",
    "axis_position": "s=AxisPosition.{axis}",
    "macro": "s=Macro.{number}",
}
Reading = Callable[[str], float]


@dataclass(frozen=True, slots=True, kw_only=True)
class NodeMap:
    """Where a kind of control keeps its variables, and what their values mean."""

    nodes: Mapping[str, str]
    """Identifier by the key of the configuration; what is not there the control does not have."""
    modes: Mapping[int, CncMode] = field(default_factory=lambda: MODES)
    runs: Mapping[int, CncRun] = field(default_factory=lambda: RUNS)
    vacant: float | None = None
    """Value of a macro variable that is vacant, where the control always gives one."""
    texts: Callable[[], Mapping[str, Reading]] = dict
    """Number of a variable that is a text; raises ValueError for a text that means nothing."""


def at_once(answers: Sequence[Answer]) -> int:
    """Return how many nodes go into one request by what a server answers to a read of `LIMITS`; 0 is no limit."""
    return min([AT_ONCE, *(each.value for each in answers if type(each.value) is int and each.value > 0)])


class Variables:
    """Node ids of one CNC, built once per connection, and requests prepared from them."""

    def __init__(
        self, found: NodeMap, namespace: int, axes: Mapping[str, AxisPositionConfig] | None = None, most: int = AT_ONCE
    ) -> None:
        self._map = found
        self._namespace_index = namespace
        self._macro_pattern = found.nodes["macro"]
        self._macros: dict[int, ua.NodeId] = {}
        self.targets: dict[int, tuple[bytes, int]] = {}
        """Of a macro variable that is written: what names it in a request, and the type that it takes."""
        self._keys = tuple(key for key in STATE_NODES if key in found.nodes)
        self._texts = [found.nodes[key] for key in self._keys]
        self._state = [self._node_id(key, text) for key, text in zip(self._keys, self._texts, strict=True)]
        self._reads: dict[tuple[int, ...], tuple[bytes, ...]] = {}
        self._most = most
        missing = [key for key in STATE_NODES if key not in self._keys]
        self.cannot = {key: f"cnc.opcua.nodes.{key} names no variable of the server" for key in missing}
        """What the control has no variable for, with the reason."""
        self._axes = axes or {}
        pattern = found.nodes.get("axis_position")
        if self._axes and pattern is None:
            self._axes = {}
            self.cannot[Capability.AXIS_POSITION] = "cnc.opcua.nodes.axis_position names no variable of the server"
        self._nowhere = dict.fromkeys(set(axes or {}) - set(self._axes), math.nan)
        of_axes = [
            str(pattern).replace("{axis}", each.axis).replace("{number}", str(each.place))
            for each in self._axes.values()
        ]
        self._positions = [self._node_id("axis_position", text) for text in of_axes]

    def read_requests(self, macros: Sequence[int], *, state: bool) -> tuple[bytes, ...]:
        """Return the parameters that read the state (or not) and the given macro variables, by request."""
        key = (int(state), *macros)
        if key not in self._reads:
            nodes = [*self._state, *self._positions] if state else []
            nodes += [self._macro_node_id(number) for number in macros]
            self._reads[key] = tuple(self._split(nodes))
        return self._reads[key]

    def ask_less(self) -> bool:
        """Put half as much into a request; False where that is one variable already."""
        self._reads.clear()
        before, self._most = self._most, (self._most + 1) // 2
        return self._most < before

    def type_requests(self, macros: Sequence[int]) -> list[bytes]:
        return self._split([self._macro_node_id(number) for number in macros], AttributeIds.DataType)

    def _split(self, nodes: Sequence[ua.NodeId], attribute: AttributeIds = AttributeIds.Value) -> list[bytes]:
        parts = range(0, len(nodes), self._most)
        return [encode_read(nodes[first : first + self._most], attribute) for first in parts]

    def learn_types(self, macros: Sequence[int], answers: Sequence[Answer]) -> None:
        """Take what a server says of types; a variable that tells no built-in one takes a Double."""
        _require_all(answers, macros)
        for number, told in zip(macros, (each.value for each in answers), strict=True):
            built_in = isinstance(told, ua.NodeId) and told.NamespaceIndex == 0 and told.Identifier in BUILT_IN
            self.targets[number] = encode_target(self._macro_node_id(number)), told.Identifier if built_in else DOUBLE

    def check_fit(self, macros: Iterable[tuple[int, float]], tolerance: float) -> None:
        """Raise NotSentError for a value that a macro variable of its type cannot hold."""
        for number, value in macros:
            kind = self.targets[number][1]
            if not abs(encode_number(value, kind)[1] - value) <= tolerance:
                raise NotSentError(
                    f"macro variable #{number} cannot hold {value!r}: in the server it is of type "
                    f"{ua.VariantType(kind).name}; name one of type Double (cnc.macros, cnc.opcua.nodes.macro); "
                    "nothing was sent"
                )

    def write_request(self, group: Sequence[tuple[int, float]]) -> tuple[Sequence[tuple[int, float]], bytes]:
        part = group[: self._most]
        targets = ((*self.targets[number], value) for number, value in part)
        return part, encode_write([(target, encode_number(value, kind)[0]) for target, kind, value in targets])

    def sample(self, time: Instant, macros: Sequence[int], answers: Sequence[Answer]) -> CncSample:
        """Return what the answers to a read of state and macros say; raises LinkError or FatalDriverError."""
        first_macro = len(self._keys) + len(self._positions)
        expected = first_macro + len(macros)
        if len(answers) != expected:
            raise LinkError(f"the CNC answered {len(answers)} values to a request for {expected}")
        values = {key: math.nan if key in (*MEASURED, "clock") else 0.0 for key in STATE_NODES}
        positions = zip(self._axes.items(), answers[len(self._keys) : first_macro], strict=True)
        for key, text, answer in zip(self._keys, self._texts, answers, strict=False):
            values[key] = self._state_value(key, text, answer)
        whole = {key: _whole(key, value) for key, value in values.items() if key not in (*MEASURED, "alarm", "clock")}
        return CncSample(
            time=time,
            mode=self._map.modes.get(whole["mode"], CncMode.UNKNOWN),
            run=self._map.runs.get(whole["run"], CncRun.UNKNOWN),
            alarm=values["alarm"] != 0,
            program=whole["program"],
            sequence_number=whole["sequence_number"],
            spindle_speed_rpm=values["spindle_speed"],
            motor_temperature_degc=values["motor_temperature"],
            clock_s=values["clock"],
            power_on_count=whole["power_on_count"],
            work_offset=whole["work_offset"],
            tool_number=whole["tool_number"],
            macros=self.macro_values(macros, answers[first_macro:]),
            positions_mm={name: _position_mm(axis, answer) for (name, axis), answer in positions} | self._nowhere,
        )

    def macro_values(self, macros: Sequence[int], answers: Sequence[Answer]) -> dict[int, float | None]:
        _require_all(answers, macros)
        return {number: self._macro_value(number, answer) for number, answer in zip(macros, answers, strict=True)}

    def _macro_value(self, number: int, answer: Answer) -> float | None:
        if answer.status == 0 and type(answer.value) is float:  # as nearly all are
            return None if math.isnan(answer.value) or answer.value == self._map.vacant else answer.value
        status = ua.StatusCode(ua.UInt32(answer.status))
        if status.value in VACANT:
            return None
        name = f"macro variable #{number} ({self._macro_pattern.replace('{number}', str(number))})"
        if not status.is_good():
            raise _unreadable(name, status)
        value = _number(name, answer)
        return None if math.isnan(value) or value == self._map.vacant else value

    def _state_value(self, key: str, text: str, answer: Answer) -> float:
        status = ua.StatusCode(ua.UInt32(answer.status))
        name = f"variable {key} ({text})"
        if status.value in UNKNOWN_NODE or not (status.is_good() or key in MEASURED):
            raise _unreadable(name, status)
        value = self._meaning(key, name, answer) if status.is_good() else math.nan
        if key not in MEASURED and not math.isfinite(value):
            raise LinkError(f"the CNC gives no value for the {name}")
        return value

    def _meaning(self, key: str, name: str, answer: Answer) -> float:
        read = self._map.texts().get(key) if isinstance(answer.value, str) else None
        if read is None:
            return _number(name, answer)
        try:
            return read(answer.value)
        except ValueError as error:
            raise LinkError(f"the CNC's {name} is {answer.value!r:.60}: {error}") from error

    def _macro_node_id(self, number: int) -> ua.NodeId:
        if number not in self._macros:
            self._macros[number] = self._node_id("macro", self._macro_pattern.replace("{number}", str(number)))
        return self._macros[number]

    def _node_id(self, key: str, text: str) -> ua.NodeId:
        try:
            return ua.NodeId.from_string(f"ns={self._namespace_index};{text}" if text[1:2] == "=" else "")
        except (UaError, ValueError) as error:
            raise FatalDriverError(
                f"cnc.opcua.nodes.{key}: {text!r} is no node identifier; write s=text or i=number, without ns="
            ) from error


def _require_all(answers: Sequence[Answer], macros: Sequence[int]) -> None:
    if len(answers) != len(macros):
        raise LinkError(f"the CNC answered {len(answers)} values to a request for {len(macros)} macro variables")


def _whole(key: str, value: float) -> int:
    """Return a number of the state, which has no fraction; G54.1, an additional offset, as 54100, for it is not G54."""
    if value.is_integer():
        return int(value)
    if key == "work_offset":
        return round(value * 1000.0)
    raise LinkError(f"the CNC's variable {key} holds {value:g}, which is no whole number: check cnc.opcua.nodes.{key}")


def _number(name: str, answer: Answer) -> float:
    value = number_in(answer.value)
    if value is None:
        return math.nan
    if not isinstance(value, (bool, int, float)):
        raise FatalDriverError(f"the CNC's {name} is a {type(value).__name__} ({value!r:.40}), not a number")
    return float(value)


def _position_mm(axis: AxisPositionConfig, answer: Answer) -> float:
    """Return the position of an axis [mm], NaN where the server gives no number."""
    good = ua.StatusCode(ua.UInt32(answer.status)).is_good()
    return position_mm(axis, float(answer.value) if good and type(answer.value) in (int, float) else None)


def _unreadable(name: str, status: ua.StatusCode) -> LinkError | FatalDriverError:
    if status.value in UNKNOWN_NODE:
        return FatalDriverError(f"the CNC's OPC UA server has no {name}: check cnc.opcua.nodes ({status.name})")
    if status.value in FORBIDDEN:
        return FatalDriverError(f"the CNC does not let its user read the {name}: give it the right ({status.name})")
    return LinkError(f"the CNC's {name} cannot be read: {status.name}, {status.doc}")
