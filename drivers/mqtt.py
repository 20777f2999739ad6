"""Numbers that devices publish over MQTT: a number, or a JSON object with it, per message."""

import contextlib
import json
import logging
import math
import secrets
import ssl
from collections.abc import Mapping, Sequence
from typing import Any

import aiomqtt

from config.files import read_whole
from config.schema.source_drivers import SourceEntry
from config.schema.source_sections import MqttBroker, MqttTopic
from config.secret_files import SecretError, read_secret
from drivers.clock import Clock
from drivers.contract import FatalDriverError, LinkError
from drivers.json_fields import number_of, readings_in
from drivers.pushing import MOST_WAITING, PushedSource
from drivers.readings import NoReading
from models.json_values import number_in
from models.quality import Reason

LARGEST_BYTES = 1 << 16
"""A longer message is not read."""
QUOTED = 80
NAMED = 8
REFUSED = 0x80
"""Answers to a subscription are refusals from here on."""
RETAINED = NoReading(reason=Reason.NOT_RECEIVED, why="was sent a retained message alone, which does not count")

logging.getLogger("mqtt").setLevel(logging.CRITICAL + 1)  # what matters is raised here


class MqttSource(PushedSource):
    """Subscribes to the sensors' topics; the newest number of each within a period counts, retained ones do not."""

    def __init__(self, source: SourceEntry, clock: Clock) -> None:
        super().__init__(source, clock)
        assert isinstance(source.connection, MqttBroker)
        self._config = source.connection
        self._where = f"source {source.name}: broker {self._config.host}:{self._config.port}"
        self._topics: dict[str, list[MqttTopic]] = {}
        for each in self._config.every_input:
            self._topics.setdefault(each.topic, []).append(each)

    async def follow(self) -> None:
        """Connect, subscribe and take what comes; raises LinkError when the broker is lost."""
        config = self._config
        connection = aiomqtt.Client(
            config.host,
            config.port,
            identifier=new_identifier(),
            username=config.user_name,
            password=self._password(),
            tls_context=self._tls(),
            timeout=config.timeout_s,
            max_queued_incoming_messages=MOST_WAITING * len(config.every_input),
        )
        ended = connection._disconnected  # when nobody takes its error, asyncio logs a traceback
        ended.add_done_callback(lambda _: ended.cancelled() or ended.exception())
        try:
            async with connection as client:
                self._refuse(await client.subscribe([(topic, 0) for topic in self._topics]))
                async for message in client.messages:
                    self._take(message)
        except (aiomqtt.MqttError, OSError, TimeoutError, UnicodeError) as error:
            raise LinkError(f"{self._where}: {self._why(error)}") from error
        finally:
            with contextlib.suppress(Exception):  # else its pair of sockets stays open until the garbage is collected
                connection._client._reset_sockets()

    def _refuse(self, answers: Sequence[Any]) -> None:
        """Say which topics the broker does not pass on; raises LinkError where that is all of them."""
        codes = [getattr(answer, "value", answer) for answer in answers]
        refused = [topic for topic, code in zip(self._topics, codes, strict=False) if code >= REFUSED]
        if refused:
            topics = ", ".join(map(repr, refused[:NAMED]))
            words = f"{self._where} refuses {topics}: let `user_name` read it, or correct `topic`"
            if len(refused) == len(self._topics):
                raise LinkError(words)
            self.report(words)

    def _why(self, error: BaseException) -> str:
        text = str(error)
        if "uthori" in text or "user name or password" in text:
            return f"refuses the connection ({text}): check `user_name` and `password_file`"
        if "CERTIFICATE_VERIFY_FAILED" in text or isinstance(error.__cause__, ssl.SSLCertVerificationError):
            return f"shows no certificate that `ca_certificate` vouches for ({error.__cause__ or error})"
        return f"{text or type(error).__name__}: check address, `port`, `tls`, network, and that the broker runs"

    def _password(self) -> str | None:
        path = self._config.password_file
        if path is None:
            return None
        try:
            return read_secret("password_file", path)
        except SecretError as error:
            raise FatalDriverError(f"{self._where}: {error}") from error

    def _tls(self) -> ssl.SSLContext | None:
        if not self._config.tls:
            return None
        path = self._config.ca_certificate
        try:
            if path is not None:
                read_whole(path)  # of a pipe OpenSSL would wait for an end
            context = ssl.create_default_context(cafile=None if path is None else str(path))
        except (OSError, ssl.SSLError) as error:
            raise FatalDriverError(f"{self._where}: ca_certificate {path} cannot be used: {error}") from error
        context.verify_flags |= ssl.VERIFY_X509_PARTIAL_CHAIN  # by the authority that signed it, though below another
        return context

    def _take(self, message: aiomqtt.Message) -> None:
        here = self._topics.get(str(message.topic), [])
        found = {} if message.retain else numbers_in(message.payload, {each.key: each.field for each in here})
        for each in here:
            if each.key in found:
                self.put(each.key, found[each.key])
            else:
                self.lacking[each.key] = RETAINED if message.retain else _without(each.field)

    def silent(self) -> str:
        """Return what to check when no message comes."""
        came = [f"; {e.in_words} {self.lacking[e.key].why}" for e in self._source.inputs if e.key in self.lacking]
        return (
            f"broker {self._config.host}:{self._config.port} has passed on no number for three cycle periods "
            f"({self._source.cycle_period_s:g} s each){''.join(came[:NAMED])}: check `topic`, and that the devices "
            "publish"
        )


def new_identifier() -> str:
    """Return a name for one connection, as long as every broker takes: not every one gives one to who has none."""
    return f"toolpoint{secrets.token_hex(7)}"


def numbers_in(payload: Any, fields: Mapping[int | str, str]) -> dict[int | str, float | NoReading]:
    """Return the numbers of a message's payload by the input's key."""
    content = payload.encode() if isinstance(payload, str) else payload
    if not isinstance(content, bytes | bytearray) or len(content) > LARGEST_BYTES:
        return dict.fromkeys(fields, _unreadable(content))
    try:
        value = json.loads(content)
    except (ValueError, RecursionError):
        value = number_in(content.decode("latin-1"))
        if not isinstance(value, float):
            return dict.fromkeys(fields, _unreadable(content))
    return readings_in(value, fields)


def fields_of(payload: Any) -> dict[str, float]:
    """Return every number of a message's payload by the field that names it."""
    if not isinstance(payload, bytes | bytearray) or len(payload) > LARGEST_BYTES:
        return {}
    try:
        waiting: list[tuple[str, Any]] = [("", json.loads(payload))]
    except (ValueError, RecursionError):
        return {}
    found: dict[str, float] = {}
    while waiting:
        field, value = waiting.pop()
        if isinstance(value, dict | list):
            within = value.items() if isinstance(value, dict) else enumerate(value)
            waiting += [(f"{field}.{key}" if field else str(key), inner) for key, inner in within]
        elif isinstance(number := number_of(value), float) and math.isfinite(number):
            found[field] = number
    return found


def _without(field: str) -> NoReading:
    return NoReading(reason=Reason.NOT_RECEIVED, why=f"was sent a message without {field!r}: correct `field`")


def _unreadable(content: Any) -> NoReading:
    quoted = (
        bytes(content[:QUOTED]).decode("utf-8", errors="replace") if isinstance(content, bytes | bytearray) else content
    )
    why = f"was sent a message that is no number and no JSON of at most {LARGEST_BYTES >> 10} KiB: {quoted!r}"
    return NoReading(reason=Reason.UNREADABLE, why=why)
