"""The CNC over OPC UA: one object is one connection, without a task of its own.

The secure channel is renewed between reads, and staleness is watched here: the library reports a frozen peer as
connected.
"""

import asyncio
import logging
import math
from collections.abc import Callable, Coroutine, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

from asyncua import ua
from asyncua.client.client import Client
from asyncua.crypto.security_policies import SecurityPolicyBasic256Sha256, SecurityPolicyNone
from asyncua.ua import uaerrors
from asyncua.ua.status_codes import StatusCodes
from asyncua.ua.uaerrors import UaError, UaStatusCodeError
from cryptography.exceptions import InvalidSignature

from config.schema.cnc import CncConfig
from config.schema.cnc_drivers import NO_NODE, OpcUaConfig
from drivers.clock import Clock
from drivers.contract import (
    Capability,
    ClockWatch,
    DriverError,
    FatalDriverError,
    LinkError,
    Security,
    refuse_forbidden,
    what_broke,
)
from drivers.opcua.bounded import bounded_client
from drivers.opcua.log import limit_library_log
from drivers.opcua.services import UNREADABLE, Answer, Services, encode_read
from drivers.opcua.variables import FANUC_NODES, LIMITS, NodeMap, Reading, Variables, at_once
from models.records import CncSample

if TYPE_CHECKING:
    from drivers.opcua.certificates import Credentials

T = TypeVar("T")
log = logging.getLogger(__name__)

SESSION_TIMEOUT_MS = 60_000
"""A CNC keeps an abandoned session this long; few sessions are all that it offers."""
RENEW_AT = 0.75
"""Share of the secure channel's lifetime after which it is renewed (OPC 10000-4, 5.5.2.1)."""
TOO_MUCH = tuple(
    getattr(uaerrors, f"Bad{what}")
    for what in ("TooManyOperations", "RequestTooLarge", "ResponseTooLarge", "EncodingLimitsExceeded")
)
"""What a server says that answers fewer values in one request."""
CONNECTING, RENEWING = "connecting", "renewing the secure channel"
NOT_TRUSTED = " (in the secure handshake: if it repeats, the server may not trust the daemon's certificate)"
AWAY = frozenset(
    {
        StatusCodes.BadCommunicationError,
        StatusCodes.BadDeviceFailure,
        StatusCodes.BadNoCommunication,
        StatusCodes.BadNotConnected,
        StatusCodes.BadOutOfService,
        StatusCodes.BadResourceUnavailable,
        StatusCodes.BadServerHalted,
        StatusCodes.BadTimeout,
        StatusCodes.BadWaitingForInitialData,
    }
)
"""What a gateway says of a written value while it does not reach the control: a lost link, no refusal."""


def node_map(config: CncConfig) -> NodeMap:
    """Return the preset's map with the identifiers that the configuration gives."""
    opcua = config.connection_as(OpcUaConfig)
    found = NodeMap(nodes=FANUC_NODES if opcua.preset == "fanuc" else {}, texts=_usual_texts)
    if opcua.preset == "sinumerik":
        from drivers.opcua.sinumerik import sinumerik_map

        found = sinumerik_map(config.guard.shown)
    given = {} if opcua.nodes is None else opcua.nodes.model_dump(exclude_none=True)
    nodes = {**found.nodes, **given}
    return replace(found, nodes={key: text for key, text in nodes.items() if text != NO_NODE})


def _usual_texts() -> Mapping[str, Reading]:
    from drivers.opcua.sinumerik import TEXTS

    return TEXTS


class OpcUaCnc:
    """Implements `drivers.contract.Cnc` over OPC UA."""

    def __init__(self, config: CncConfig, clock: Clock) -> None:
        limit_library_log()
        self._config = config
        self._clock = clock
        self._opcua = config.connection_as(OpcUaConfig)
        self._endpoint = self._opcua.endpoint
        self._client: Client | None = None
        self._variables: Variables | None = None
        self._services: Services | None = None
        self._lost: str | None = None
        self._renew_at_s = math.inf
        self._watch = ClockWatch(self._endpoint, config.stale_after_s)
        self.identity = ""
        self.cannot: dict[str, str] = {}
        self.security: Security = "encrypted" if self._opcua.encrypted else "insecure"

    async def connect(self) -> None:
        """Connect, check that the server is the right one and offers the configured variables."""
        if self._client is not None or self._lost is not None:
            raise LinkError(f"{self._endpoint}: this connection was used up; build a new one")
        credentials: Credentials = None
        if security := self._opcua.security:
            from drivers.opcua.certificates import load_credentials

            credentials = load_credentials(security)
        try:
            await self._call(CONNECTING, self._connect(credentials))
        except BaseException as error:
            if isinstance(error, asyncio.CancelledError):
                self._lost = "cancelled"
            await self.close()
            raise

    async def read(self, macros: Sequence[int]) -> CncSample:
        """Read the machine's state and the given macro variables, in one request if the server takes it."""
        services, variables = self._connected()
        if self._clock.now().real_s >= self._renew_at_s and self._client is not None:
            await self._call(RENEWING, self._renew(self._client))
        wanted = partial(variables.read_requests, macros, state=True)
        answers = await self._call("reading", self._read(services, variables, wanted))
        sample = variables.sample(self._clock.now(), macros, answers)
        if stands := self._watch.stands_still(sample):
            self._lose(stands)
        return sample

    async def read_macros(self, macros: Sequence[int]) -> dict[int, float | None]:
        """Read macro variables; None where a variable is vacant."""
        services, variables = self._connected()
        wanted = partial(variables.read_requests, macros, state=False)
        answers = await self._call("reading macro variables", self._read(services, variables, wanted))
        return variables.macro_values(macros, answers)

    async def write_macros(self, groups: Sequence[Sequence[tuple[int, float]]]) -> None:
        """Write groups of (macro, value), each only after the previous one was accepted; raises as `Cnc` says."""
        refuse_forbidden(groups, self._config, self.security)
        services, variables = self._connected()
        await self._call("writing macro variables", self._write(services, variables, groups))

    async def close(self) -> None:
        """Close the session, the channel and the socket; never raises, never waits longer than the time-out."""
        client, self._client = self._client, None
        if client is None:
            return
        try:
            if self._lost is None:
                async with asyncio.timeout(self._config.timeout_s):
                    await cancelled_plainly(client.close_session())
                    await cancelled_plainly(client.close_secure_channel())
        except (OSError, UaError) as error:
            log.debug("%s: the session could not be closed properly: %r", self._endpoint, error)
        except Exception as error:
            log.warning("%s: closing the session failed: %r", self._endpoint, error)
        finally:
            self._lost = self._lost or "closed"
            abort(client)
        await asyncio.sleep(0)

    async def _connect(self, credentials: "Credentials") -> None:
        offered = await bounded_client(self._endpoint, self._config.timeout_s).connect_and_get_server_endpoints()
        mode, policy = check_offer(self._endpoint, offered, credentials, "cnc.opcua.security")
        client = self._client = bounded_client(self._endpoint, self._config.timeout_s)
        client.name, client.product_uri = "Toolpoint", "urn:toolpoint"
        client.session_timeout = SESSION_TIMEOUT_MS
        if credentials:
            credentials.secure(client)
        await client.connect_socket()
        await client.send_hello()
        await client.open_secure_channel()
        session = await client.create_session()
        self.identity = Client.find_endpoint(session.ServerEndpoints, mode, policy).Server.ApplicationUri
        user, password = (credentials.user_name, credentials.password) if credentials else (None, None)
        await client.activate_session(username=user, password=password)
        self._schedule_renewal(client)
        self._services = Services(client.uaclient, self._config.timeout_s)
        self._variables = await self._find_variables(client, self._services)

    async def _find_variables(self, client: Client, services: Services) -> Variables:
        uri = self._opcua.namespace
        namespaces = await client.get_namespace_array()
        if uri not in namespaces:
            raise FatalDriverError(
                f"{self._endpoint} has no namespace {uri!r} (cnc.opcua.namespace_uri); it has {', '.join(namespaces)}"
            )
        most = at_once(await services.read([encode_read([node]) for node in LIMITS]))
        variables = Variables(node_map(self._config), namespaces.index(uri), self._config.axis_positions, most)
        block = self._config.macros.block
        answers = await self._read(services, variables, partial(variables.read_requests, block, state=True))
        sample = variables.sample(self._clock.now(), block, answers)
        self._watch.stands_still(sample)
        measured = {"spindle_speed": sample.spindle_speed_rpm, "motor_temperature": sample.motor_temperature_degc}
        self.cannot = variables.cannot | {
            name: f"the server gives no value for cnc.opcua.nodes.{name}"
            for name, value in measured.items()
            if math.isnan(value) and name not in variables.cannot
        }
        if lacking := [name for name, value in sample.positions_mm.items() if math.isnan(value)]:
            why = f"the server gives no value for cnc.opcua.nodes.axis_position of {', '.join(lacking)}"
            self.cannot.setdefault(Capability.AXIS_POSITION, why)
        return variables

    async def _read(
        self, services: Services, variables: Variables, wanted: Callable[[], Sequence[bytes]]
    ) -> list[Answer]:
        """Return what is wanted, in as many requests as the server needs: not every one tells how much it takes."""
        while True:
            try:
                return await services.read(wanted())
            except TOO_MUCH:
                if not variables.ask_less():
                    raise

    async def _write(
        self, services: Services, variables: Variables, groups: Sequence[Sequence[tuple[int, float]]]
    ) -> None:
        every = [pair for group in groups for pair in group]
        if unknown := [number for number, _ in every if number not in variables.targets]:
            types = await self._read(services, variables, partial(variables.type_requests, unknown))
            variables.learn_types(unknown, types)
        variables.check_fit(every, self._config.macros.tolerance)
        for group in groups:
            left = group
            while left:
                part, request = variables.write_request(left)
                try:
                    statuses = await services.write(request)
                except TOO_MUCH:  # and nothing of it was written
                    if not variables.ask_less():
                        raise
                    continue
                self._check_written(part, statuses)
                left = left[len(part) :]

    def _check_written(self, part: Sequence[tuple[int, float]], statuses: Sequence[int]) -> None:
        if len(statuses) != len(part):
            raise LinkError(f"{self._endpoint} answered {len(statuses)} statuses to {len(part)} writes")
        for (number, value), code in zip(part, statuses, strict=True):
            if code != 0 and not (status := ua.StatusCode(ua.UInt32(code))).is_good():
                text = f"the CNC refused macro variable #{number} = {value!r}: {status.name}, {status.doc}"
                raise LinkError(text) if code in AWAY else FatalDriverError(text)

    def _schedule_renewal(self, client: Client) -> None:
        lifetime_s = client.secure_channel_timeout / 1000
        self._renew_at_s = self._clock.now().real_s + RENEW_AT * lifetime_s

    async def _renew(self, client: Client) -> None:
        await client.open_secure_channel(renew=True)
        client.uaclient.revolve_security_token()
        self._schedule_renewal(client)

    def _connected(self) -> tuple[Services, Variables]:
        if self._client is None or self._services is None or self._variables is None or self._lost is not None:
            raise LinkError(f"{self._endpoint}: not connected ({self._lost or 'never connected'})")
        return self._services, self._variables

    def _lose(self, reason: str, cause: BaseException | None = None) -> NoReturn:
        self._lost = reason
        raise LinkError(reason) from cause

    async def _call(self, what: str, call: Coroutine[Any, Any, T]) -> T:
        """Await a call within the time-out and turn what the library raises into the contract's errors."""
        try:
            async with asyncio.timeout(self._config.timeout_s):
                return await cancelled_plainly(call)
        except DriverError:
            raise
        except TimeoutError as error:
            self._lose(
                f"{self._endpoint} did not answer within {self._config.timeout_s:g} s while {what}{self._suspicion()}",
                error,
            )
        except InvalidSignature as error:
            raise FatalDriverError(f"{self._endpoint} signs with another key than its certificate's") from error
        except UaStatusCodeError as error:
            from drivers.opcua.certificates import REFUSALS

            if what == CONNECTING and error.code in REFUSALS:
                name = ua.StatusCode(error.code).name
                raise FatalDriverError(f"{self._endpoint} {REFUSALS[error.code]} ({name})") from error
            self._lose(f"{self._endpoint} reported {ua.StatusCode(error.code).name} while {what}", error)
        except (OSError, UaError, UnicodeError) as error:  # the last of a host's name that is none
            self._lose(f"{self._endpoint} was lost while {what}: {what_broke(error)}{self._suspicion()}", error)
        except UNREADABLE as error:
            if what not in (CONNECTING, RENEWING):  # elsewhere the answer is decoded here, and this is a defect
                raise
            self._lose(f"{self._endpoint} answers what cannot be read while {what} ({type(error).__name__})", error)

    def _suspicion(self) -> str:
        """Say what a server that breaks off the secure handshake without a word usually means."""
        return NOT_TRUSTED if self.security == "encrypted" and self._client is not None and not self.identity else ""


def check_offer(
    where: str, offered: Sequence[ua.EndpointDescription], credentials: "Credentials", key: str
) -> tuple[ua.MessageSecurityMode, str]:
    """Return mode and policy of the session; raises FatalDriverError, with the key, for one that is not to be had."""
    mode, policy = ua.MessageSecurityMode.None_, SecurityPolicyNone.URI
    if credentials is not None:
        mode, policy = ua.MessageSecurityMode.SignAndEncrypt, SecurityPolicyBasic256Sha256.URI
    matching = [e for e in offered if e.SecurityMode == mode and e.SecurityPolicyUri == policy]
    if not matching:
        offers = sorted({f"{e.SecurityPolicyUri.rpartition('#')[2]} {e.SecurityMode.name}" for e in offered})
        advice = "" if credentials else f"; configure {key}"
        raise FatalDriverError(
            f"{where} offers {', '.join(offers) or 'nothing'}, not {policy.rpartition('#')[2]} {mode.name}{advice}"
        )
    wanted = ua.UserTokenType.UserName if credentials else ua.UserTokenType.Anonymous
    told = {token.TokenType for e in matching for token in e.UserIdentityTokens or []}
    if told and wanted not in told:
        lacks = "user names" if credentials else f"anonymous sessions; configure {key}"
        raise FatalDriverError(f"{where} accepts no {lacks}")
    if credentials:
        credentials.check_shown(where, matching[0].ServerCertificate, key)
    return mode, policy


async def cancelled_plainly(call: Coroutine[Any, Any, T]) -> T:
    """Await a call of the library with cancellation as asyncio's time-out knows it.

    When a call ends in the instant it is given up, the library raises a class of its own below CancelledError; asyncio
    would not turn that into a TimeoutError, and it would end the task that waits.
    """
    try:
        return await call
    except asyncio.CancelledError as cancelled:
        raise asyncio.CancelledError from cancelled


def abort(client: Client) -> None:
    """Drop the socket at once: a graceful close would wait for a peer that may be gone."""
    client.uaclient.request_disconnect()
    protocol = client.uaclient.protocol
    if protocol is not None and protocol.transport is not None:
        protocol.transport.abort()
    client.disconnect_socket()
