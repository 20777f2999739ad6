"""The Sparkplug B 3.0 sink: a machine's computer is an edge node, the machine its device.

    spBv1.0/GROUP/NBIRTH/MACHINE, NDEATH, NCMD
    spBv1.0/GROUP/DBIRTH/MACHINE/DEVICE, DDATA, DDEATH

The specification has data without acknowledgement (quality of service 0). So after every batch the subscription to the
commands is renewed: its acknowledgement comes after all that was sent before. That the broker passes on what the node
publishes, however large, shows in the births and the first data, which come back to it: the device's birth holds every
metric. A batch counts as taken when the connection has lasted a while longer. Rows older than what was told at birth
are historical.
"""

import contextlib
import functools
import itertools
import json
import threading
import time
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from importlib.metadata import version

import structlog

from config.schema.sinks import SinkConfig
from daemon.history.cursors import Cursor, Position
from daemon.sinks.ahead import Ahead
from daemon.sinks.broker import ALWAYS, AT_ONCE, IF_NEW, Broker, Message
from daemon.sinks.broker_refusals import own_unheard, primary_host_offline, primary_host_went
from daemon.sinks.contract import Progress, SinkError, SinkWaitsError
from daemon.sinks.current import Freshness
from daemon.sinks.mqtt import topic_level
from daemon.sinks.outbox import STREAMS, Batch, Outbox
from daemon.sinks.sparkplug_metrics import DataType, Metric, asks_for_rebirth, encode, row_metrics

log = structlog.get_logger(__name__)
NAMESPACE = "spBv1.0"
REBIRTH = "Node Control/Rebirth"
NUMBERS = 256
"""Messages of a session are numbered 0 to 255 over and over, and so are sessions."""
TOLD_AT_BIRTH = 20
"""So many of the newest rows of each stream make the values of a birth: every line is among them."""
REBIRTH_PERIOD_S = 1.0
"""Commands that come sooner after a birth are answered together, by one: hosts that start at once all ask."""
MOST_UNHEARD = 20
"""So many messages of a topic that have not come back are kept."""
_sessions: defaultdict[str, Iterator[int]] = defaultdict(itertools.count)


class PrimaryHost:
    """What the topic STATE of a host says; an older message than the last one counts for nothing.

    Sparkplug 2.2 has a topic and words of its own, which count until the host has said something as 3.0 has it.
    """

    def __init__(self, name: str) -> None:
        self.topic, self.topic_2_2 = f"{NAMESPACE}/STATE/{name}", f"STATE/{name}"
        self.online = False
        self._speaks_3_0 = False
        self._newest_ms: float = -1

    def forget(self) -> None:
        """Take the next message whatever its time: the clock of a host may have been set back."""
        self._newest_ms = -1

    def update(self, topic: str, content: bytes) -> None:
        if topic == self.topic_2_2:
            if not self._speaks_3_0 and content in (b"ONLINE", b"OFFLINE"):
                self.online = content == b"ONLINE"
            return
        try:
            said = json.loads(content)
            online, newest_ms = said["online"], said["timestamp"]
        except (ValueError, RecursionError, TypeError, KeyError):
            return
        if isinstance(online, bool) and isinstance(newest_ms, int | float) and newest_ms >= self._newest_ms:
            self.online, self._newest_ms, self._speaks_3_0 = online, newest_ms, True


class SparkplugSink:
    """One session of one edge node."""

    def __init__(self, config: SinkConfig, machine: str) -> None:
        assert config.sparkplug is not None
        section = config.sparkplug
        self._where = f"sink {config.name}: broker {section.host}:{section.server_port}"
        self._broker = Broker(section, self._where, f"toolpoint-{config.name}-{machine}", older=True)
        self._topic = f"{NAMESPACE}/{section.group}/{{}}/{topic_level(machine)}"
        self._device = section.device
        self._host = None if section.primary_host is None else PrimaryHost(section.primary_host)
        self._bd_seq = next(_sessions[self._topic]) % NUMBERS
        self._lock = threading.RLock()
        """Held while messages are numbered and handed over: a rebirth is answered by the library's thread."""
        self._seq = itertools.count()
        self._born = self._alive = False
        """Whether the node and its device were born."""
        self._born_s = float("-inf")
        self._asked = False
        """Whether a host has asked for a birth since the last one."""
        births = self._topic.format("NBIRTH"), self._of_device("DBIRTH")
        self._unheard: dict[str, tuple[int, ...]] = dict.fromkeys((*births, self._of_device("DDATA")), ())
        """Topic -> hashes of what has not come back from the broker, the newest last; of data that of the first row."""
        self._told: dict[str, Metric] = {}
        """The newest metrics, of which births are made."""
        self._born_ms: dict[str, int] = {}
        self._ahead = Ahead(section.resend_s)
        self._freshness = Freshness()

    def open(self, cursor: Cursor) -> Mapping[str, Position]:
        """Connect, with the node's death as will, and subscribe; the cursor says how far the broker has come."""
        self._broker.on_message(self._on_message)
        self._broker.connect(Message(topic=self._topic.format("NDEATH"), payload=self._death()))
        self._broker.subscribe(self._commands)
        self._broker.subscribe(f"{self._topic.format('DCMD')}/{self._device}")
        for topic in self._unheard:
            self._broker.subscribe(topic)
        if self._host is not None:
            self._ask_for(self._host, IF_NEW)
        return cursor.positions

    def _ask_for(self, host: PrimaryHost, retained: int) -> None:
        """Subscribe to what the host says, that of 3.0 first; the topic of 2.2 may be forbidden."""
        self._broker.subscribe(host.topic, retained)
        with contextlib.suppress(SinkError):
            self._broker.subscribe(host.topic_2_2, retained)
        self._broker.check()

    def close(self) -> None:
        """Close the connection; the broker publishes the death of a node that was born."""
        self._broker.close(will=self._born)

    def needs_rows(self) -> bool:
        self._broker.check()
        return not self._asked

    def transfer(self, outbox: Outbox, progress: Progress) -> bool:
        """Send a batch of each stream; True while one of them has more."""
        self._ahead.settle(progress)
        if self._host is not None and not self._host.online:
            self._host.forget()
            self._ask_for(self._host, ALWAYS)
            raise SinkWaitsError(f"{self._where}: {primary_host_offline(self._host.topic)}")
        if not self._born:
            self._learn(outbox)
            self._bear()
            self._wait_for_own()
        elif self._asked:
            self._bear()
        more = sent = False
        for stream in STREAMS.values():
            batch = outbox.batch(stream, self._ahead.position(progress, stream.name))
            if batch is not None:
                self._send(batch)
                self._ahead.took(batch)
                sent, more = True, more or not batch.last
        if not self._freshness.fresh(outbox) and not sent:
            self._die()
        self._ahead.settle(progress)
        return more

    # --- births and deaths -------------------------------------------------------------------

    @property
    def _commands(self) -> str:
        return self._topic.format("NCMD")

    def _learn(self, outbox: Outbox) -> None:
        """Read what is newest of every stream."""
        for stream in STREAMS.values():
            end = outbox.end(stream)
            newest = outbox.batch(stream, replace(end, row=max(0, end.row - TOLD_AT_BIRTH)))
            if newest is None:
                continue
            self._born_ms[stream.name] = max(row[0] for row in newest.rows)
            for row in newest.rows[-TOLD_AT_BIRTH:]:
                self._told |= {each.name: each for each in row_metrics(stream, row)}

    def _bear(self) -> None:
        """Publish the births of the node and of its device; a host may ask for them again at any time."""
        with self._lock:
            self._seq = itertools.count()
            self._born_s, self._asked = time.monotonic(), False
            now_ms = _now_ms()
            made = [
                Metric(name="bdSeq", datatype=DataType.INT64, value=self._bd_seq, utc_ms=now_ms),
                Metric(name=REBIRTH, datatype=DataType.BOOLEAN, value=False, utc_ms=now_ms),
                Metric(name="Properties/Software", datatype=DataType.STRING, value="Toolpoint", utc_ms=now_ms),
                Metric(name="Properties/Version", datatype=DataType.STRING, value=version("toolpoint"), utc_ms=now_ms),
            ]
            self._publish(self._topic.format("NBIRTH"), made)
            self._born = True
            self._bear_device()

    def _bear_device(self) -> None:
        with self._lock:
            self._publish(self._of_device("DBIRTH"), self._told.values())
            self._alive = True

    def _wait_for_own(self) -> None:
        """Wait until what was published last has come back: a broker drops without a word what it does not pass on."""
        for topic, waiting in self._unheard.items():
            if waiting:
                came = functools.partial(self._came_back, topic, waiting[-1])
                self._broker.wait_for(came, own_unheard(topic))

    def _came_back(self, topic: str, payload: int) -> bool:
        return payload not in self._unheard[topic]

    def _die(self) -> None:
        with self._lock:
            if self._alive:
                self._alive = False
                self._publish(self._of_device("DDEATH"), ())

    def _death(self) -> bytes:
        now_ms = _now_ms()
        number = Metric(name="bdSeq", datatype=DataType.INT64, value=self._bd_seq, utc_ms=now_ms)
        return encode([number], utc_ms=now_ms, seq=None)

    # --- data --------------------------------------------------------------------------------

    def _send(self, batch: Batch) -> None:
        """Publish the rows of a batch, each as one message, and wait until the broker has them."""
        waiting, data = iter(batch.rows), self._of_device("DDATA")
        while rows := list(itertools.islice(waiting, 1 if data in self._unheard else AT_ONCE)):
            for row in rows:
                self._send_row(batch, row)
            self._broker.subscribe(self._commands)
            self._broker.check()
            self._wait_for_own()
            with self._lock:
                first = self._unheard.pop(data, None) is not None
            if first:
                self._broker.unsubscribe(data)

    def _send_row(self, batch: Batch, row: tuple[object, ...]) -> None:
        metrics = row_metrics(batch.stream, row)
        if not metrics:
            return
        with self._lock:
            for at, each in enumerate(metrics):
                told, born_ms = self._told.get(each.name), self._born_ms.get(batch.stream.name, -1)
                if each.utc_ms <= born_ms or (told is not None and each.utc_ms <= told.utc_ms):
                    metrics[at] = replace(each, historical=True)
                if told is None:
                    self._alive = False
                if told is None or each.utc_ms > told.utc_ms:
                    self._told[each.name] = each
            if not self._alive:
                self._bear_device()
            self._publish(self._of_device("DDATA"), metrics)

    def _publish(self, topic: str, metrics: Iterable[Metric]) -> None:
        payload = encode(metrics, utc_ms=_now_ms(), seq=next(self._seq) % NUMBERS)
        if topic in self._unheard:
            self._unheard[topic] = (*self._unheard[topic][-MOST_UNHEARD:], hash(payload))
        self._broker.send(Message(topic=topic, payload=payload, qos=0))

    def _of_device(self, kind: str) -> str:
        return f"{self._topic.format(kind)}/{self._device}"

    # --- what comes from hosts, in the library's thread --------------------------------------

    def _on_message(self, topic: str, content: bytes, retained: bool) -> None:
        if topic == self._commands and not retained and asks_for_rebirth(content, REBIRTH):
            with self._lock:
                self._asked = self._born
                if self._born and time.monotonic() - self._born_s >= REBIRTH_PERIOD_S:
                    log.info("sparkplug.rebirth", topic=topic)
                    self._bear()
        elif topic in self._unheard:
            with self._lock:
                waiting = self._unheard.get(topic, ())
                if (payload := hash(content)) in waiting:
                    self._unheard[topic] = waiting[waiting.index(payload) + 1 :]
        elif self._host is not None and topic in (self._host.topic, self._host.topic_2_2):
            self._host.update(topic, content)
            if self._born and not self._host.online:
                self._broker.leave(primary_host_went(topic))


def _now_ms() -> int:
    return round(time.time() * 1e3)
