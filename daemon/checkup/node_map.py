"""Proposes the map of a control's variables from what its OPC UA server shows, by names that they usually have."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from asyncua import ua

from config.schema.cnc_drivers import NEEDED_NODES, NO_NODE, SINUMERIK_NAMESPACE, OpcUaSecurityConfig
from config.schema.guard import GuardConfig
from drivers.opcua.browsing import Browsed, Variable, browse, values_of
from drivers.opcua.sinumerik import TEXTS, sinumerik_map
from drivers.opcua.tags import TagSession
from drivers.opcua.variables import FANUC_NODES
from models.json_values import number_in

READ_AT_ONCE = 25
"""Some variables hold whole tables or programs."""
USUAL_NAMES: dict[str, tuple[str, ...]] = {
    "mode": ("mode", "opmode", "operatingmode", "operationmode", "ncmode", "aut"),
    "run": ("runstate", "run", "runstatus", "progstatus", "programstatus", "executionstate", "execution"),
    "alarm": ("alarm", "alarmstatus", "alarmactive", "alarmstate", "chanalarm"),
    "program": ("program", "mainprogram", "programnumber", "programno", "onumber", "activeprogram"),
    "sequence_number": ("sequencenumber", "sequenceno", "nnumber", "blocknumber"),
    "spindle_speed": ("spindlespeed", "actspindlespeed", "actualspindlespeed", "spindleactspeed", "actspeed"),
    "motor_temperature": ("spindlemotortemperature", "motortemperature", "spindletemperature"),
    "clock": ("clock", "timer", "poweronclock", "timesincepoweron"),
    "power_on_count": ("poweroncount", "powercount", "poweronnumber"),
    "work_offset": ("workoffset", "activeworkoffset", "workcoordinate", "workcoordinatesystem"),
    "tool_number": ("toolnumber", "toolno", "acttnumber", "activetool", "toolinspindle"),
}
"""Names of the variables by key, the best first, in small letters without anything between."""
_NUMBERED = re.compile(r"(.*?(?:macro|variable|common|custom|#)\D*?)(\d{3,5})(\D*)", re.IGNORECASE)


@dataclass(frozen=True, slots=True, kw_only=True)
class Proposal:
    """What the configuration might say of this server."""

    preset: str
    namespace: str
    nodes: dict[str, str]
    """Identifiers that the preset does not have."""
    missing: tuple[str, ...] = ()
    """Keys of which nothing was found."""
    others: dict[str, tuple[str, ...]] = field(default_factory=dict)
    """More variables that have such a name, by key."""
    values: dict[str, Any] = field(default_factory=dict)
    """What the proposed variables hold now, by key."""

    def section(self, endpoint: str) -> dict[str, Any]:
        """Return `cnc.opcua` as it would stand in the configuration."""
        section: dict[str, Any] = {"endpoint": endpoint, "preset": self.preset}
        if self.namespace != SINUMERIK_NAMESPACE:
            section["namespace_uri"] = self.namespace
        nodes = self.nodes | dict.fromkeys((key for key in self.missing if key not in NEEDED_NODES), NO_NODE)
        return section | ({"nodes": nodes} if nodes else {})


@dataclass(frozen=True, slots=True)
class _Place:
    endpoint: str
    security: OpcUaSecurityConfig | None
    timeout_s: float


async def look(
    endpoint: str, security: OpcUaSecurityConfig | None, timeout_s: float, guard: GuardConfig | None = None
) -> tuple[Browsed, Proposal | None]:
    """Return what the server shows, and a proposal where anything has a usual name; raises DriverError."""
    session = TagSession(_Place(endpoint, security, timeout_s), endpoint, READ_AT_ONCE)
    try:
        await session.connect()
        browsed = await browse(session)
        if SINUMERIK_NAMESPACE not in browsed.namespaces:
            return browsed, propose(browsed)
        nodes = dict(sinumerik_map((guard or GuardConfig()).shown).nodes)
        nodes["macro"] = nodes["macro"].replace("{number}", "1")
        index = browsed.namespaces.index(SINUMERIK_NAMESPACE)
        held = await values_of(session, [ua.NodeId.from_string(f"ns={index};{text}") for text in nodes.values()])
    finally:
        await session.close()
    values = dict(zip(nodes, held, strict=True))
    missing = tuple(key for key, value in values.items() if value is None)
    return browsed, Proposal(
        preset="sinumerik", namespace=SINUMERIK_NAMESPACE, nodes={}, missing=missing, values=values
    )


def propose(browsed: Browsed) -> Proposal | None:
    """Return the map of the namespace in which most variables have usual names, None where none has one."""
    proposals = [
        _of_namespace(namespace, [variable for variable in browsed.variables if variable.namespace == namespace])
        for namespace in browsed.namespaces[1:]
    ]
    best = min(proposals, key=lambda each: len(each.missing), default=None)
    return best if best is not None and best.values else None


def _of_namespace(namespace: str, variables: Sequence[Variable]) -> Proposal:
    nodes: dict[str, str] = {}
    others: dict[str, tuple[str, ...]] = {}
    values: dict[str, Any] = {}
    for key, names in USUAL_NAMES.items():
        ranked = sorted(
            (names.index(_bare(variable.name)), place)
            for place, variable in enumerate(variables)
            if _bare(variable.name) in names and _means_something(key, variable.value)
        )
        if ranked:
            first, *rest = (variables[place] for _, place in ranked)
            nodes[key], values[key] = first.node, first.value
            if rest:
                others[key] = tuple(variable.node for variable in rest)
    patterns = _macro_patterns(variables)
    if patterns:
        nodes["macro"], *rest_of_patterns = patterns
        values["macro"] = None
        if rest_of_patterns:
            others["macro"] = tuple(rest_of_patterns)
    missing = tuple(key for key in (*USUAL_NAMES, "macro") if key not in nodes)
    fanuc = all(FANUC_NODES[key] == node for key, node in nodes.items())
    return Proposal(
        preset="fanuc" if fanuc else "generic",
        namespace=namespace,
        nodes={} if fanuc else nodes,
        missing=missing,
        others=others,
        values=values,
    )


def _bare(name: str) -> str:
    return re.sub(r"[^a-z0-9]", "", name.lower())


def _means_something(key: str, value: Any) -> bool:
    """Return whether a value, or none at the moment, can be what the key stands for."""
    try:
        meaning = TEXTS[key](value) if isinstance(value, str) and key in TEXTS else number_in(value)
    except ValueError:
        return False
    return meaning is None or isinstance(meaning, (bool, int, float))


def _macro_patterns(variables: Sequence[Variable]) -> list[str]:
    """Return identifiers with {number} in the place of a number, the one that most variables fit first."""
    fitting: dict[str, int] = {}
    for variable in variables:
        if (match := _NUMBERED.fullmatch(variable.node)) and "{" not in variable.node:
            pattern = f"{match[1]}{{number}}{match[3]}"
            fitting[pattern] = fitting.get(pattern, 0) + 1
    return sorted(fitting, key=lambda pattern: -fitting[pattern])
