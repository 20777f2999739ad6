"""The methods: the commands of the local socket, with the operator's right and the person's name in the audit."""

from typing import Any

from asyncua import ua
from asyncua.ua.status_codes import StatusCodes

from daemon.monitor.accounts import Role
from daemon.monitor.commands import CommandDesk
from daemon.monitor.control_socket import RequestError
from daemon.monitor.opcua.tags import INDEX, Tags
from daemon.monitor.opcua.users import OpcUaPerson, Report
from drivers.opcua.server.encoding import Encoded, Kind, variant
from drivers.opcua.server.space import COMPONENT, CallRefusedError, Method, Space
from drivers.opcua.server.standard import add_arguments

STRING, BOOLEAN = ua.NodeId(ua.Int32(Kind.STRING)), ua.NodeId(ua.Int32(Kind.BOOLEAN))
AXES = ua.Argument(
    Name="Axes",
    DataType=STRING,
    ValueRank=1,
    Description=ua.LocalizedText("names of the axes; an empty list: every axis"),
)
ZERO = ua.Argument(
    Name="Zero",
    DataType=BOOLEAN,
    ValueRank=-1,
    Description=ua.LocalizedText(
        "retreat to zero instead of to where the reference left it; with an empty list of axes"
    ),
)
OUTPUTS = [
    ua.Argument(
        Name="Decided", DataType=BOOLEAN, ValueRank=-1, Description=ua.LocalizedText("false: look at the state")
    ),
    ua.Argument(Name="State", DataType=STRING, ValueRank=-1, Description=ua.LocalizedText("state of the output")),
    ua.Argument(Name="Reason", DataType=STRING, ValueRank=-1, Description=ua.LocalizedText("why")),
]
METHODS: dict[str, tuple[str, list[ua.Argument], tuple[type, ...]]] = {
    "reference": ("set the reference now, as after work positioning", [], ()),
    "enable": ("switch compensation on", [AXES], (list,)),
    "disable": ("switch compensation off; the offset retreats", [AXES, ZERO], (list, bool)),
    "acknowledge": ("clear a latched FAULT after its cause is gone", [], ()),
}


class Actions:
    """Adds the methods to a space and carries them out."""

    def __init__(self, desk: CommandDesk, report: Report, tags: Tags) -> None:
        self._desk, self._report, self._tags = desk, report, tags

    def add_all(self, space: Space) -> None:
        for name, (words, inputs, types) in METHODS.items():
            method = Method((INDEX, name), name, words, self._doing(name), inputs=types, may=_may)
            space.add(method, self._tags.machine, COMPONENT)
            add_arguments(space, method, inputs, OUTPUTS)

    def _doing(self, name: str) -> Any:
        async def call(person: OpcUaPerson, values: list[Any]) -> list[Encoded]:
            return await self._act(name, person, values)

        return call

    async def _act(self, name: str, person: OpcUaPerson, values: list[Any]) -> list[Encoded]:
        """Hand a command to the desk that serves the local socket and the monitor too."""
        if not _may(person):
            self._report("access", f"refused: OPC UA method {name} takes the role {Role.OPERATOR}", person.in_audit)
            sentence = f"{person.name} is {person.role}; this takes the role {Role.OPERATOR}"
            raise self._refused(name, int(StatusCodes.BadUserAccessDenied), sentence)
        command: dict[str, Any] = {"command": name}
        if values and values[0]:
            command["axes"] = list(values[0])
        if len(values) > 1 and values[1]:
            command["zero"] = True
        try:
            outcome = await self._desk.handle(command, person.in_audit)
        except RequestError as error:
            raise self._refused(name, int(StatusCodes.BadInvalidState), str(error)) from error
        return [
            variant(Kind.BOOLEAN, bool(outcome["decided"])),
            variant(Kind.STRING, outcome.get("state", "")),
            variant(Kind.STRING, outcome.get("reason", "")),
        ]

    def _refused(self, name: str, status: int, sentence: str) -> CallRefusedError:
        self._tags.refuse(f"{name}: {sentence}")
        return CallRefusedError(status, sentence)


def _may(person: OpcUaPerson) -> bool:
    return person.role.covers(Role.OPERATOR)
