"""A connection to a broker: what was published counts when the broker has acknowledged it.

With MQTT 5 the broker tells what it refuses, and when nobody reads; who can do without that may use 3.1.1.
"""

import contextlib
import functools
import itertools
import logging
import threading
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import paho.mqtt.client as paho
from paho.mqtt.enums import CallbackAPIVersion
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties
from paho.mqtt.reasoncodes import ReasonCode
from paho.mqtt.subscribeoptions import SubscribeOptions

from config.schema.sinks import BrokerConfig
from config.secret_files import SecretError, read_secret
from daemon.sinks.broker_refusals import (
    closed_at_once,
    lost,
    may_not_publish,
    may_not_subscribe,
    no_acknowledgement,
    reason,
    refusal,
    unanswered,
)
from daemon.sinks.contract import SinkError
from daemon.sinks.vouching import tls_context

PING_PERIOD_S = 20
STORE_PROPERTY = "store"
"""Under this name a row says of which history store it is."""
LARGEST_MESSAGE = 1 << 20
"""The broker is told to leave out what is larger [bytes]: nothing but commands and births comes here."""
AT_ONCE = 500
"""Messages that are handed over together, of which IN_FLIGHT wait for their acknowledgement at a time."""
IN_FLIGHT = 20
"""The library's own limit; it does not look at that of the broker."""
ALWAYS, IF_NEW = 0, 1
"""Retained messages come when a subscription is made; whether they come again when it is renewed."""
NOBODY, UNKNOWN_VERSION, NOT_AUTHORISED, WITHOUT_WILL, WITH_WILL = 16, 132, 135, 0, 4
"""Reason codes: taken and passed on to nobody; unknown version; not allowed; farewells without the will and with it."""

logging.getLogger("paho").setLevel(logging.CRITICAL + 1)  # what matters is raised here


@dataclass(frozen=True, slots=True, kw_only=True)
class Message:
    topic: str
    payload: bytes
    qos: int = 1
    retain: bool = False
    store: str = ""
    """The history store of which it is a row, which goes along as a property; '' for none."""


class NotUnderstoodError(SinkError):
    """The broker did not answer as one that speaks this version does; the text says how."""


class Broker:
    """One session with one broker, of which a new one is made after a loss."""

    def __init__(self, config: BrokerConfig, where: str, client_id: str, *, older: bool = False) -> None:
        """`older`: MQTT 3.1.1 will do where the broker does not understand 5."""
        self._config, self._where, self._client_id, self._older = config, where, client_id, older
        self._changed = threading.Condition()
        self._connected = False
        self._lost = ""
        self._at_once = AT_ONCE
        self._acknowledged: set[int] = set()
        """Numbers of messages; the library tells those of such as have no acknowledgement too, when they went out."""
        self._nobody = 0
        self._refused: tuple[int, int, str] | None = None
        """Number of the message, code and words of the last refusal."""
        self._granted: ReasonCode | None = None
        self._on_message: paho.CallbackOnMessage | None = None
        self._will: Message | None = None
        """What this end publishes before a farewell in the older version, in which the broker drops the will."""
        self._client = self._made(paho.MQTTv5)

    def _made(self, version: Any) -> paho.Client:
        client = paho.Client(CallbackAPIVersion.VERSION2, self._client_id, protocol=version, reconnect_on_failure=False)
        client.connect_timeout = self._config.timeout_s
        client.on_connect = self._on_connect
        client.on_disconnect = self._on_disconnect
        client.on_publish = self._on_publish
        client.on_subscribe = self._on_subscribe
        client.on_message = self._on_message
        return client

    def connect(self, will: Message) -> None:
        """Connect, with what the broker is to publish when this end is lost; raises SinkError."""
        properties = Properties(PacketTypes.CONNECT)  # type: ignore[no-untyped-call]
        properties.MaximumPacketSize = LARGEST_MESSAGE
        try:
            self._connect(will, clean_start=True, properties=properties)
        except NotUnderstoodError:
            if not self._older:
                raise
            self.close()
            self._client, self._lost, self._will = self._made(paho.MQTTv311), "", will
            self._connect(will)

    def _connect(self, will: Message, **of_version: Any) -> None:
        client, config = self._client, self._config
        set_credentials(client, config, self._where)
        client.will_set(will.topic, will.payload, will.qos, will.retain)
        try:
            client.connect(config.host, config.server_port, PING_PERIOD_S, **of_version)
        except (OSError, ValueError) as error:
            raise SinkError(f"{self._where}: {refusal(error, config)}") from error
        client.loop_start()
        with self._changed:
            if not self._changed.wait_for(lambda: self._connected or self._lost, config.timeout_s):
                raise NotUnderstoodError(f"{self._where}: {unanswered(config)}")
            if not self._connected and not self._refused:
                raise NotUnderstoodError(f"{self._where}: {self._lost}")
        self.check()

    def check(self) -> None:
        """Raise SinkError when the connection was lost."""
        if self._lost:
            raise SinkError(f"{self._where}: {self._lost}")

    def publish(self, messages: Iterable[Message]) -> bool:
        """Publish, wait for the acknowledgements; False: the broker says that one of them had no subscriber."""
        waiting, reached = iter(messages), True
        while some := list(itertools.islice(waiting, self._at_once)):
            reached = self._publish(some) and reached
        return reached

    def _publish(self, messages: list[Message]) -> bool:
        with self._changed:
            self._acknowledged.clear()
            self._nobody, self._refused = 0, None
        topics = {
            self._client.publish(
                each.topic, each.payload, each.qos, each.retain, _properties(each.store)
            ).mid: each.topic
            for each in messages
        }
        with self._changed:
            while not self._lost and not (
                len(self._acknowledged) >= len(topics) and topics.keys() <= self._acknowledged
            ):
                before = len(self._acknowledged)
                if not self._changed.wait(self._config.timeout_s) and len(self._acknowledged) == before:
                    raise SinkError(f"{self._where}: {no_acknowledgement(self._config)}")
            if self._refused is not None:
                number, code, name = self._refused
                topic = topics[number]
                why = may_not_publish(topic, name) if code == NOT_AUTHORISED else f"{topic}: {reason(code, name)}"
                raise SinkError(f"{self._where}: {why}")
        self.check()
        return self._nobody == 0

    def on_message(self, take: Callable[[str, bytes, bool], None]) -> None:
        """Hand over topic, content and whether it was retained of what comes, in the library's thread."""

        def handle(_client: Any, _data: Any, each: paho.MQTTMessage) -> None:
            take(each._topic.decode("utf-8", "replace"), bytes(each.payload), each.retain)
            with self._told():
                pass

        self._on_message = self._client.on_message = handle

    def subscribe(self, topic: str, retained: int = IF_NEW) -> None:
        """Subscribe, and wait for the acknowledgement: the broker has then what was sent before, too."""
        with self._changed:
            self._granted = None
        if self._will is None:
            self._client.subscribe(topic, options=SubscribeOptions(qos=1, retainHandling=retained))
        else:
            self._client.subscribe(topic, qos=1)
        with self._changed:
            if not self._changed.wait_for(lambda: self._granted is not None or self._lost, self._config.timeout_s):
                raise SinkError(f"{self._where}: {no_acknowledgement(self._config)}")
            granted = self._granted
        self.check()
        if granted is not None and granted.is_failure:
            raise SinkError(f"{self._where}: {may_not_subscribe(topic, str(granted))}")

    def unsubscribe(self, topic: str) -> None:
        """Let the broker send a topic no longer."""
        self._client.unsubscribe(topic)

    def wait_for(self, came: Callable[[], bool], otherwise: str) -> None:
        """Wait for something that comes; raises SinkError with this text when it does not."""
        if not self.comes(came, self._config.timeout_s):
            raise self.problem(otherwise)

    def comes(self, came: Callable[[], bool], within_s: float) -> bool:
        """Wait for something that comes, at most so long; return whether it did. Raises SinkError after a loss."""
        with self._changed:
            done = self._changed.wait_for(lambda: came() or bool(self._lost), within_s)
        self.check()
        return done

    def problem(self, text: str) -> SinkError:
        return SinkError(f"{self._where}: {text}")

    def send(self, message: Message) -> None:
        """Publish what has no acknowledgement of its own."""
        self._client.publish(message.topic, message.payload, message.qos, message.retain)

    def leave(self, why: str) -> None:
        """End the session from the library's thread, so that the will is published; `check` says why."""
        with self._told():
            self._lost = self._lost or why
        self._say_farewell()

    def close(self, *, will: bool = True) -> None:
        """Say farewell so that the will is published, or not, and let go."""
        self._say_farewell(WITH_WILL if will else WITHOUT_WILL)
        self._client.loop_stop()

    def _say_farewell(self, code: int = WITH_WILL) -> None:
        with contextlib.suppress(OSError, ValueError):
            if self._will is not None and self._connected and code == WITH_WILL:
                self.send(self._will)
            self._client.disconnect(ReasonCode(PacketTypes.DISCONNECT, identifier=code))

    # --- in the library's thread -----------------------------------------------------------

    def _on_connect(self, _client: Any, _data: Any, _flags: Any, code: ReasonCode, properties: Any) -> None:
        with self._told():
            if code.is_failure:
                self._lost = self._lost or reason(code.value, str(code))
                self._refused = None if code.value == UNKNOWN_VERSION else (0, code.value, str(code))
            else:
                allowed = getattr(properties, "ReceiveMaximum", IN_FLIGHT)
                self._at_once = AT_ONCE if allowed >= IN_FLIGHT else allowed
                self._connected = True

    def _on_disconnect(self, _client: Any, _data: Any, _flags: Any, code: ReasonCode, _properties: Any) -> None:
        with self._told():
            if not self._connected:
                self._lost = self._lost or closed_at_once(self._config)
            else:
                self._lost = self._lost or lost(code.value, str(code))

    def _on_publish(self, _client: Any, _data: Any, number: int, code: ReasonCode, _properties: Any) -> None:
        with self._told():
            self._acknowledged.add(number)
            self._nobody += code.value == NOBODY
            if code.is_failure:
                self._refused = number, code.value, str(code)

    def _on_subscribe(self, _client: Any, _data: Any, _number: int, codes: list[ReasonCode], _properties: Any) -> None:
        with self._told():
            self._granted = next(iter(codes), None)

    @contextlib.contextmanager
    def _told(self) -> Iterator[None]:
        with self._changed:
            yield
            self._changed.notify_all()


@functools.lru_cache(maxsize=16)
def _properties(store: str) -> Properties | None:
    if not store:
        return None
    properties = Properties(PacketTypes.PUBLISH)  # type: ignore[no-untyped-call]
    properties.UserProperty = (STORE_PROPERTY, store)
    return properties


def set_credentials(client: paho.Client, config: BrokerConfig, where: str) -> None:
    """Give a client the user, the password and the certificates that a section names; raises SinkError."""
    path = config.password_file
    try:
        if config.user_name is not None:
            client.username_pw_set(config.user_name, None if path is None else read_secret("password_file", path))
        if config.tls:
            client.tls_set_context(tls_context(config.ca_certificate))
    except SecretError as error:
        raise SinkError(f"{where}: {error}") from error
