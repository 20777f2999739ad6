"""The MQTT sink: what is now as one retained JSON object, told to Home Assistant, and the history row by row as JSON.

    TOPIC/MACHINE/status            online or offline, retained; offline by the broker when this end is lost
    TOPIC/MACHINE/state             what is now, retained
    TOPIC/MACHINE/history/STREAM    a row of the history, not retained
    TOPIC/MACHINE/store             which store sends: a second one of the name is refused

The cursor moves when the broker has acknowledged a row and the connection has lasted a while longer.
"""

import json
import re
import time
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from importlib.metadata import version
from typing import Any

import structlog

from config.schema.sinks import SinkConfig
from daemon.history.cursors import Cursor, Position
from daemon.sinks.ahead import Ahead
from daemon.sinks.broker import Broker, Message
from daemon.sinks.broker_refusals import name_in_use, nobody_subscribes
from daemon.sinks.contract import Progress, SinkError, SinkWaitsError
from daemon.sinks.current import Freshness, current_values
from daemon.sinks.outbox import STREAMS, Batch, Outbox
from daemon.sinks.row_messages import row_messages

VERSION = version("toolpoint")
TELL_AGAIN_S = 300.0
"""What is retained is published again after this time: others may have written or deleted it."""
NOT_IN_A_LEVEL = re.compile(r"[/+#%\x00-\x1f\x7f]")


log = structlog.get_logger(__name__)
ANSWER_S = 1.0
"""Another one has so long to answer before the first row goes."""
LATELY_S = 60.0
"""Whose rows the broker took so lately had the name: after a loss or a restart they do not wait for an answer."""
CLAIM, TAKEN = "claim", "taken"
_refused: set[tuple[str, str]] = set()
"""Topic and store that another one was in the way of: its rows wait for an answer again."""
TRIES = 3
_broken_off: Counter[tuple[str, str]] = Counter()
"""How often the connection was lost there in a row: a broker may do so where the user has no right to read."""


LONGEST_STATE = 250
"""Home Assistant takes no longer text as a state."""
UM = {"unit_of_measurement": "µm", "state_class": "measurement", "suggested_display_precision": 1}
DEGC = {"device_class": "temperature", "unit_of_measurement": "°C", "state_class": "measurement"}
RPM = {"unit_of_measurement": "rpm", "state_class": "measurement"}
PROBLEM = {"device_class": "problem", "payload_on": "ON", "payload_off": "OFF"}
BY_NAME: Mapping[str, tuple[str, str, Mapping[str, Any]]] = {
    "compensation_um": ("compensation", "Compensation", UM),
    "applied_um": ("applied", "Applied compensation", UM),
    "error_without_um": ("error_without", "Thermal error without compensation", UM),
    "error_with_um": ("error_with", "Thermal error with compensation", UM),
    "displacement_um": ("displacement", "Displacement", UM),
    "label_degc": ("temperature", "Temperature", DEGC),
}
"""Field of the current values -> object, words and unit of its numbers."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Entity:
    """One value in Home Assistant."""

    component: str
    object_id: str
    name: str
    template: str
    more: Mapping[str, Any] = field(default_factory=dict)


def plain_id(text: str) -> str:
    """Return letters, digits and underscores that stand for a text and, but for case, for no other."""
    plain = re.sub(r"[^a-z0-9]+", "_", text.lower()).strip("_")
    return plain if plain == text.lower() else f"{plain}_{zlib.crc32(text.encode()):08x}"


def entities(values: Mapping[str, Any]) -> Iterator[Entity]:
    """Yield what the current values hold."""
    text = f"{{{{ (value_json.%s or '')[:{LONGEST_STATE}] }}}}"
    yield Entity(component="sensor", object_id="state", name="State", template="{{ value_json.state }}")
    yield Entity(component="sensor", object_id="reason", name="Reason", template=text % "reason")
    yield Entity(component="sensor", object_id="alarm_text", name="Alarm text", template=text % "alarm")
    alarm = "{{ 'None' if value_json.%s is none else 'ON' if value_json.%s else 'OFF' }}"  # None is not known
    for name, words in (("alarm", "Alarm"), ("cnc_alarm", "CNC alarm")):
        yield Entity(component="binary_sensor", object_id=name, name=words, template=alarm % (name, name), more=PROBLEM)
    for name, (object_id, words, unit) in BY_NAME.items():
        for key in values[name]:
            template = f"{{{{ value_json.{name}[{json.dumps(key, ensure_ascii=False)}] }}}}"
            yield Entity(
                component="sensor",
                object_id=f"{object_id}_{plain_id(key)}",
                name=f"{words} {key}",
                template=template,
                more=unit,
            )
    speed = "{{ value_json.spindle_speed_rpm }}"
    yield Entity(component="sensor", object_id="spindle_speed", name="Spindle speed", template=speed, more=RPM)


def discovery(
    prefix: str, machine: str, base: str, values: Mapping[str, Any], version: str
) -> Iterator[tuple[str, bytes]]:
    """Yield topic and payload of every entity of a machine whose topics begin with `base`."""
    node = plain_id(machine)
    for entity in entities(values):
        content = {
            "name": entity.name,
            "unique_id": f"toolpoint_{node}_{entity.object_id}",
            "state_topic": f"{base}/state",
            "value_template": entity.template,
            "availability_topic": f"{base}/status",
            **entity.more,
            "device": {
                "identifiers": [f"toolpoint_{node}"],
                "name": machine,
                "manufacturer": "Toolpoint",
                "model": "thermal compensation",
                "sw_version": version,
            },
            "origin": {"name": "Toolpoint", "sw_version": version},
        }
        topic = f"{prefix}/{entity.component}/toolpoint_{node}/{entity.object_id}/config"
        yield topic, json.dumps(content, ensure_ascii=False).encode()


class OneName:
    """The claim of one store to a machine's name, at one connection."""

    def __init__(self, broker: Broker, topic: str, cursor: Cursor, machine: str) -> None:
        self._broker, self._topic, self._store, self._machine = broker, topic, cursor.generation, machine
        self._key = topic, cursor.generation
        lately = 0.0 <= time.time() - (cursor.acknowledged_utc_s or 0.0) < LATELY_S
        self._waits = not lately or self._key in _refused
        self._own = False
        """Whether the claim came back: from then on it is answered for."""
        self.taken = False

    def begin(self) -> None:
        """Claim the name; raises SinkError where another one has it."""
        if _broken_off[self._key] < TRIES:
            _broken_off[self._key] += 1
            self._claim()
        del _broken_off[self._key]
        self.check()
        if self._own:
            _refused.discard(self._key)
            return
        why = "`user_name` may not read and write there, so a second computer with the same `machine` is not noticed"
        log.warning("sink.name", topic=self._topic, problem=why)

    def _claim(self) -> None:
        self._broker.on_message(self._take)
        with suppress(SinkError):
            self._broker.subscribe(self._topic)
            self._broker.publish([self._message(CLAIM)])
            self._broker.comes(lambda: self.taken or (self._own and not self._waits), ANSWER_S)
        self._broker.check()

    def check(self) -> None:
        """Raise SinkError where another one has the name."""
        if self.taken:
            _refused.add(self._key)
            raise self._broker.problem(name_in_use(self._machine, self._topic))

    def _take(self, topic: str, content: bytes, retained: bool) -> None:
        """Take a message, in the library's thread."""
        said, _, store = content.decode("utf-8", "replace").partition(" ")
        if topic != self._topic or retained or said not in (CLAIM, TAKEN):
            return
        if store == self._store:
            self._own = True
        elif said == TAKEN or not self._own:
            self.taken = True
        elif not self.taken:
            self._broker.send(self._message(TAKEN, qos=0))  # an acknowledgement would be counted as that of a row

    def _message(self, word: str, qos: int = 1) -> Message:
        return Message(topic=self._topic, payload=f"{word} {self._store}".encode(), qos=qos)


def topic_level(name: str) -> str:
    """Return a name as one level of a topic; what may not stand there becomes its number after a %."""
    return NOT_IN_A_LEVEL.sub(lambda found: f"%{ord(found[0]):02X}", name)


class MqttSink:
    """One connection to one broker."""

    def __init__(self, config: SinkConfig, machine: str) -> None:
        assert config.mqtt is not None
        self._config, self._machine = config.mqtt, machine
        self._base = f"{config.mqtt.topic}/{topic_level(machine)}"
        self._where = f"sink {config.name}: broker {config.mqtt.host}:{config.mqtt.server_port}"
        self._client_id = f"toolpoint-{config.name}-{machine}"
        self._opened: tuple[Broker, OneName] | None = None
        self._ahead = Ahead(config.mqtt.resend_s)
        self._freshness = Freshness()
        self._told: dict[str, bytes] = {}
        self._told_s = time.monotonic()
        self._unread: set[str] = set()
        self._store = ""
        """The history store whose rows are sent."""

    def open(self, cursor: Cursor) -> Mapping[str, Position]:
        """Connect; the cursor says how far the broker has come."""
        broker = Broker(self._config, self._where, f"{self._client_id}{cursor.generation[:8]}")
        name = OneName(broker, f"{self._base}/store", cursor, self._machine)
        self._opened = broker, name
        broker.connect(self._retained("status", b"offline"))
        name.begin()
        return cursor.positions

    def close(self) -> None:
        """Close the connection; the broker tells that this machine is offline, unless another one sends for it."""
        if self._opened is not None:
            broker, name = self._opened
            broker.close(will=not name.taken)

    @property
    def _broker(self) -> Broker:
        assert self._opened is not None
        return self._opened[0]

    def needs_rows(self) -> bool:
        assert self._opened is not None
        for each in self._opened:
            each.check()
        return True

    def transfer(self, outbox: Outbox, progress: Progress) -> bool:
        """Tell what is now, then send a batch of each stream; True while one of them has more."""
        self._store = progress.cursor.generation
        self._ahead.settle(progress)
        self._tell(outbox)
        more = False
        for stream in STREAMS.values():
            if stream.name not in self._config.history:
                if (end := outbox.end(stream)) != progress.position(stream.name):
                    progress.acknowledged(stream.name, end, None, sent=0, stored=0)
                continue
            batch = outbox.batch(stream, self._ahead.position(progress, stream.name))
            if batch is None:
                continue
            if self._send(batch):
                self._ahead.took(batch)
                more |= not batch.last
        self._ahead.settle(progress)
        if self._unread:
            raise SinkWaitsError(f"{self._where}: {nobody_subscribes(sorted(self._unread))}")
        return more

    def _send(self, batch: Batch) -> bool:
        """Publish a batch; False when nobody has subscribed. Where nobody had, one row goes ahead."""
        topic = f"{self._base}/history/{batch.stream.name}"
        rows = (Message(topic=topic, payload=each, store=self._store) for each in row_messages(batch, self._machine))
        reached = topic not in self._unread or self._broker.publish([next(rows)])
        if reached and self._broker.publish(rows):
            self._unread.discard(topic)
            return True
        self._unread.add(topic)
        return False

    def _tell(self, outbox: Outbox) -> None:
        """Publish what is now and has changed; now and then all of it."""
        if time.monotonic() - self._told_s >= TELL_AGAIN_S:
            self._told, self._told_s = {}, time.monotonic()
        values = current_values(outbox)
        waiting: list[Message] = []
        if self._config.discovery is not None:
            for topic, payload in discovery(self._config.discovery, self._machine, self._base, values, VERSION):
                waiting += self._changed(Message(topic=topic, payload=payload, retain=True))
        content: dict[str, Any] = {"machine": self._machine, **values}
        payload = json.dumps(content, ensure_ascii=False, allow_nan=False).encode()
        waiting += self._changed(self._retained("state", payload))
        status = b"online" if self._freshness.fresh(outbox) else b"offline"
        waiting += self._changed(self._retained("status", status))
        self._broker.publish(waiting)

    def _retained(self, name: str, payload: bytes) -> Message:
        return Message(topic=f"{self._base}/{name}", payload=payload, retain=True)

    def _changed(self, message: Message) -> list[Message]:
        if self._told.get(message.topic) == message.payload:
            return []
        self._told[message.topic] = message.payload
        return [message]
