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
from collections.abc import Mapping
from importlib.metadata import version
from typing import Any

from config.schema.sinks import SinkConfig
from daemon.history.cursors import Cursor, Position
from daemon.sinks.ahead import Ahead
from daemon.sinks.broker import Broker, Message
from daemon.sinks.broker_refusals import nobody_subscribes
from daemon.sinks.contract import Progress, SinkWaitsError
from daemon.sinks.current import Freshness, current_values
from daemon.sinks.discovery import discovery
from daemon.sinks.one_name import OneName
from daemon.sinks.outbox import STREAMS, Batch, Outbox
from daemon.sinks.row_messages import row_messages

VERSION = version("toolpoint")
TELL_AGAIN_S = 300.0
"""What is retained is published again after this time: others may have written or deleted it."""
NOT_IN_A_LEVEL = re.compile(r"[/+#%\x00-\x1f\x7f]")


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

    def transfer(self, outbox: Outbox, progress: Progress) -> bool:
        """Tell what is now, then send a batch of each stream; True while one of them had one."""
        assert self._opened is not None
        for each in self._opened:
            each.check()
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
                more = True
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
