"""A control behind an MTConnect agent: its state is read, nothing is ever written.

Each read asks for every observation since the last one, by the agent's sequence; where some are forgotten, for the
present state; another instance of the agent, or devices that it has changed, are a lost link.
"""

import asyncio
import contextlib
from collections.abc import Mapping, Sequence
from datetime import datetime
from http import HTTPStatus
from typing import NoReturn
from urllib.parse import quote

import h11

from config.schema.cnc import CncConfig
from config.schema.cnc_drivers import MtconnectConfig
from drivers.clock import Clock
from drivers.contract import SIMULATED_CNC_IDENTITY, Capability, FatalDriverError, NotSentError
from drivers.linked_cnc import LinkedCnc
from drivers.mtconnect.device import READS_ONLY, Device, chosen_device
from drivers.mtconnect.xml import LONGEST_DOCUMENT, Element, XmlError, parsed
from models.records import CncSample

COUNT = 500
"""Observations of one answer."""
MOST_ANSWERS = 8
"""After so many answers the present state is read instead of the rest."""
SIMULATED_UUID = "toolpoint-simulated"
FORGOTTEN = "OUT_OF_RANGE"


PIECE = 65_536
LONGEST_HEAD = 16_384


class HttpError(ValueError):
    """The answer is not HTTP, or none that is read here; the text says why."""


async def fetch(host: str, port: int, target: str) -> tuple[int, bytes]:
    """Return status and body, whatever they are, of what lies at a target; raises OSError, HttpError."""
    reader, writer = await asyncio.open_connection(host, port)
    try:
        connection = h11.Connection(h11.CLIENT, max_incomplete_event_size=LONGEST_HEAD)
        name = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
        headers = [("Host", name), ("Accept", "application/xml, text/xml"), ("Accept-Encoding", "identity")]
        headers.append(("Connection", "close"))
        request = connection.send(h11.Request(method="GET", target=target, headers=headers))
        writer.write((request or b"") + (connection.send(h11.EndOfMessage()) or b""))
        return await _body(reader, connection)
    except h11.RemoteProtocolError as error:
        raise HttpError(f"it is no HTTP ({error})") from error
    finally:
        writer.transport.abort()


async def _body(reader: asyncio.StreamReader, connection: h11.Connection) -> tuple[int, bytes]:
    status, body = 0, bytearray()
    while True:
        event = connection.next_event()
        if event is h11.NEED_DATA:
            connection.receive_data(await reader.read(PIECE))
        elif isinstance(event, h11.Data):
            body += event.data
            if len(body) > LONGEST_DOCUMENT:
                raise HttpError(f"it is longer than {LONGEST_DOCUMENT} byte")
        elif isinstance(event, h11.EndOfMessage):
            return status, bytes(body)
        elif isinstance(event, h11.Response | h11.InformationalResponse):
            status = event.status_code
        else:
            raise HttpError("it ends before it is whole")


class AgentError(ValueError):
    """The agent answers with an error or with what it was not asked for; the text says which."""

    def __init__(self, sentence: str, code: str = "") -> None:
        super().__init__(sentence)
        self.code = code


class AgentLink:
    """Stands for the agent's connections, which are made anew for each request."""

    def __init__(self) -> None:
        self.lost: str | None = None

    def abort(self, reason: str) -> None:
        """Note that the agent is not asked any more."""
        self.lost = self.lost or reason

    async def ended(self) -> None:
        """There is nothing to wait for."""


class MtconnectCnc(LinkedCnc[AgentLink]):
    """Implements `drivers.contract.Cnc` on an agent; what it cannot is most of it."""

    wrong_answers = (HttpError, XmlError, AgentError)

    def __init__(self, config: CncConfig, clock: Clock) -> None:
        self._agent = config.connection_as(MtconnectConfig)
        super().__init__(config, clock, self._agent.address)
        self._device: Device | None = None
        self._instance = self._changed = ""
        self._next = 0

    @property
    def cannot(self) -> Mapping[str, str]:
        """What this control does not give, with the reason (known after connect)."""
        return {} if self._device is None else dict(self._device.cannot)

    async def write_macros(self, groups: Sequence[Sequence[tuple[int, float]]]) -> None:
        """Refuse: an agent only reads. Raises NotSentError, LinkError without a link."""
        self._standing()
        raise NotSentError(f"nothing was sent: {READS_ONLY} (cnc.driver)")

    async def _connect(self) -> None:
        self._link = AgentLink()
        root = await self._probe()
        if root.name != "MTConnectDevices":
            raise FatalDriverError(
                f"{self._name} is no MTConnect agent: its probe is a {root.name}; check cnc.mtconnect.url"
            )
        device = chosen_device(root, self._config)
        self._device = device
        self.identity = SIMULATED_CNC_IDENTITY if device.uuid == SIMULATED_UUID else f"mtconnect:{device.uuid}"
        self._instance = _header(root).get("instanceId", "")
        self._changed = _header(root).get("deviceModelChangeTime", "")
        await self._read_current(device)

    async def _probe(self) -> Element:
        """Return what the agent tells of the configured device: what that of a plant tells of all may be too long."""
        if self._agent.device is not None:
            with contextlib.suppress(*self.wrong_answers):  # it does not know the name, and then says which there are
                return await self._asked("/probe", self._agent.device)
        return await self._asked("/probe")

    async def _sample(self, macros: Sequence[int]) -> CncSample:
        device = self._device
        assert device is not None
        clock_s = await self._follow(device)
        return CncSample(
            time=self._clock.now(),
            mode=device.mode,
            run=device.run,
            alarm=device.alarm,
            program=device.program,
            sequence_number=device.sequence_number,
            spindle_speed_rpm=device.number(Capability.SPINDLE_SPEED),
            motor_temperature_degc=device.number(Capability.MOTOR_TEMPERATURE),
            clock_s=clock_s,
            power_on_count=0,
            work_offset=device.work_offset,
            tool_number=device.tool_number,
            macros=await self._macros(macros),
            positions_mm=device.positions_mm(),
        )

    async def _macros(self, macros: Sequence[int]) -> dict[int, float | None]:
        return dict.fromkeys(macros)

    async def _write(self, groups: Sequence[Sequence[tuple[int, float]]]) -> NoReturn:
        raise NotSentError(READS_ONLY)

    async def _follow(self, device: Device) -> float:
        """Take every observation since the last read; return when the agent answered [s since 1970]."""
        for _ in range(MOST_ANSWERS):
            try:
                root = await self._asked(f"/sample?from={self._next}&count={COUNT}")
            except AgentError as error:
                if error.code != FORGOTTEN:
                    raise
                break
            header = self._checked(root)
            device.observe(root, anew=False)
            if self._next > _number(header, "lastSequence"):
                return _time_s(header)
        return await self._read_current(device)

    async def _read_current(self, device: Device) -> float:
        root = await self._asked("/current")
        header = self._checked(root)
        device.observe(root, anew=True)
        return _time_s(header)

    def _checked(self, root: Element) -> dict[str, str]:
        """Return the header of an answer and note where the next begins; raises LinkError for another instance."""
        if root.name != "MTConnectStreams":
            raise AgentError(f"a {root.name} instead of MTConnectStreams")
        header = _header(root)
        if header.get("instanceId", "") != self._instance:
            self._lose(f"{self._name}: the agent was started anew; what it told before counts no longer")
        if self._changed and header.get("deviceModelChangeTime", self._changed) != self._changed:
            self._lose(f"{self._name}: the agent's devices were changed; their data items may be others now")
        self._next = _number(header, "nextSequence")
        return header

    async def _asked(self, target: str, device: str = "") -> Element:
        """Return the document at a target; raises AgentError for one that tells an error."""
        agent = self._agent
        name = self._device.name if self._device is not None else device
        below = f"/{quote(name, safe='')}" if name else ""
        try:
            status, content = await fetch(agent.host, agent.port, f"{quote(agent.path, safe='/%')}{below}{target}")
        except ConnectionRefusedError as error:
            sentence = "refuses the connection: check cnc.mtconnect.url, and that the agent runs"
            self._lose(f"{self._name} {sentence}", error)
        try:
            root = await parsed(content)
        except XmlError as error:
            if status == HTTPStatus.OK:
                raise
            raise HttpError(f"HTTP status {status} and no document of an agent; check cnc.mtconnect.url") from error
        if root.name == "MTConnectError":
            code, words = _told(root)
            raise AgentError(f"the agent says {code or 'an error'}: {words}", code)
        return root


def _told(error: Element) -> tuple[str, str]:
    """Return code and words of a document that tells an error; since 2.6 each kind has an element of its own name."""
    errors = error.first("Errors") or error
    found = next((each for each in errors.children if "errorCode" in each.attributes), errors)
    message = found.first("ErrorMessage") or found
    return found.attributes.get("errorCode", ""), message.text.strip()[:200]


def _header(root: Element) -> dict[str, str]:
    header = root.first("Header")
    return {} if header is None else header.attributes


def _number(header: dict[str, str], name: str) -> int:
    text = header.get(name, "")
    if not (text.isascii() and text.isdecimal() and len(text) <= 20):
        raise AgentError(f"its header gives no {name}")
    return int(text)


def _time_s(header: dict[str, str]) -> float:
    try:
        return datetime.fromisoformat(header.get("creationTime", "")).timestamp()
    except ValueError as error:
        raise AgentError("its header gives no creationTime") from error
