"""The plant's store: takes the rows that machines publish over MQTT and puts them into the plant's database.

A message is acknowledged when the transaction that holds its row is committed, and the broker keeps the session: what
this process had not stored when it was killed comes again, which the keys of the tables make harmless. A message that
is no row is acknowledged and named in the log, because it would come for ever.
"""

import contextlib
import json
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import paho.mqtt.client as paho
import psycopg
import structlog
from paho.mqtt.enums import CallbackAPIVersion
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties
from paho.mqtt.reasoncodes import ReasonCode
from psycopg import errors

from config.files import read_whole, write_whole
from config.schema.plant_store import PlantStoreConfig, SubscriptionConfig
from daemon.sinks.broker import STORE_PROPERTY, set_credentials
from daemon.sinks.broker_refusals import closed_at_once, lost, no_acknowledgement, reason, refusal, two_computers
from daemon.sinks.contract import Retry, SinkError
from daemon.sinks.database import STORE, Database, time_of
from daemon.sinks.mqtt import topic_level
from daemon.sinks.outbox import DAY_MS, STREAMS, Stream
from daemon.sinks.postgresql_refusals import left_out, less_than_stored
from daemon.sinks.row_messages import JSON_COLUMNS
from daemon.sinks.same_name import SameName
from models.json_values import printable

log = structlog.get_logger(__name__)
SESSION_S = 30 * 86_400
"""The broker keeps the session of a store that is away for so long."""
UNSTORED = 1000
"""Messages that the broker sends before the first of them is acknowledged, where its own limit is not lower."""
PING_PERIOD_S = 20
LOOK_PERIOD_S = 0.5
TELL_PERIOD_S = 5.0
"""How often the service manager hears that the process works, and how it fares."""
LESS_PERIOD_S = 60.0
"""How often it is looked whether the database has less than was put there, and what was put there is kept."""
LEFT_OUT_NAMED, LEFT_OUT_PERIOD_S = 10, 60.0
LONGEST_NAME = 200
LARGEST_MESSAGE = 1 << 18
"""The broker is told to leave out what is larger [bytes]; a row of a thousand sensors has some 30 kB."""
LONGEST_PROBLEM = 500
ARRAYS = {"temperatures": ("sensor_ids", "degc", "quality", "reason"), "references": ("sensor_ids", "degc")}
TIMES = ("utc_ms", "cycle_utc_ms")
TEXTS = frozenset(
    (
        *("line", "model_id", "reference_id", "cause", "person", "state", "reason", "outcome", "detail"),
        *("mode", "run", "kind", "text", "source", "axis"),
    )
)
ADDED_LATER = ("positions_mm",)
"""Columns that rows from machines with an earlier version do not have."""
Newest = dict[tuple[str, str], int]
"""Machine and stream -> time of the newest row that was put there [ms]."""
FAULTS_OF_A_ROW = (
    *(psycopg.DataError, errors.NotNullViolation),
    *(errors.ProgramLimitExceeded, errors.StatementTooComplex),  # a key that is too long, JSON that is too deep
)


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredRow:
    stream: Stream
    machine: str
    utc_ms: int
    values: tuple[Any, ...]


def row_of(topic: str, payload: bytes, base: str) -> StoredRow:
    """Return the row of a message; raises ValueError with what is wrong with it."""
    try:
        content = json.loads(payload, parse_constant=_no_number)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"no JSON: {error}") from error
    if not isinstance(content, dict):
        raise ValueError("no JSON object")
    name, machine, utc_ms = content.get("stream"), content.get("machine"), content.get("utc_ms")
    if not isinstance(machine, str) or not 0 < len(machine) <= LONGEST_NAME:
        raise ValueError("`machine` is no name")
    if (stream := STREAMS.get(str(name))) is None or topic != f"{base}/{topic_level(machine)}/history/{name}":
        raise ValueError("`machine` and `stream` are not those of its topic")
    if type(utc_ms) is not int:
        raise ValueError("`utc_ms` is no whole number")
    if missing := [column for column in stream.columns if column not in content and column not in ADDED_LATER]:
        raise ValueError(f"`{missing[0]}` is missing")
    values = tuple(_value(stream, column, content.get(column)) for column in stream.columns)
    return StoredRow(stream=stream, machine=machine, utc_ms=utc_ms, values=values)


def _no_number(name: str) -> None:
    raise ValueError(f"{name} is no number")


def _value(stream: Stream, column: str, value: Any) -> Any:
    if column in TIMES:
        try:
            return time_of(value)
        except (TypeError, OverflowError) as error:
            raise ValueError(f"`{column}` is no time") from error
    if column in JSON_COLUMNS:
        value = None if value is None else json.dumps(value, ensure_ascii=False)
        fits = value is None or _has_characters_only(value)
    elif column in ARRAYS.get(stream.name, ()):
        fits = isinstance(value, list) and all(_is_number(each) for each in value)
    elif column in TEXTS:
        fits = value is None or (isinstance(value, str) and _has_characters_only(value))
    else:
        fits = isinstance(value, bool) or _is_number(value)
    if not fits:
        raise ValueError(f"`{column}` is not what that field holds")
    return value


def _is_number(value: Any) -> bool:
    """Whether it is a finite number or None."""
    return value is None or type(value) is int or (type(value) is float and math.isfinite(value))


def _has_characters_only(text: str) -> bool:
    """Whether a text can be written in UTF-8: JSON may hold halves of characters."""
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


class Subscription:
    """One connection to the broker, whose session outlives it; a new one is made after every SinkError."""

    def __init__(self, config: SubscriptionConfig) -> None:
        self._config = config
        self._where = f"broker {config.host}:{config.server_port}"
        self._changed = threading.Condition()
        self._arrived: deque[paho.MQTTMessage] = deque()
        self._subscribed, self._lost = False, ""
        self._client = paho.Client(
            CallbackAPIVersion.VERSION2,
            config.client_id,
            protocol=paho.MQTTv5,
            reconnect_on_failure=False,
            manual_ack=True,
        )
        self._client.connect_timeout = config.timeout_s
        self._client.on_connect = self._on_connect
        self._client.on_subscribe = self._on_subscribe
        self._client.on_disconnect = self._on_disconnect
        self._client.on_message = self._on_message

    def open(self) -> None:
        """Connect and subscribe; raises SinkError."""
        config, client = self._config, self._client
        set_credentials(client, config, self._where)
        properties = Properties(PacketTypes.CONNECT)  # type: ignore[no-untyped-call]
        properties.SessionExpiryInterval, properties.ReceiveMaximum = SESSION_S, UNSTORED
        properties.MaximumPacketSize = LARGEST_MESSAGE
        try:
            client.connect(config.host, config.server_port, PING_PERIOD_S, clean_start=False, properties=properties)
        except (OSError, ValueError) as error:
            raise SinkError(f"{self._where}: {refusal(error, config)}") from error
        client.loop_start()
        with self._changed:
            if not self._changed.wait_for(lambda: self._subscribed or self._lost, config.timeout_s):
                raise SinkError(f"{self._where}: {no_acknowledgement(config)}")
        self._check()

    def take(self, within_s: float) -> list[paho.MQTTMessage]:
        """Return what has arrived, in its order; raises SinkError when the connection was lost."""
        with self._changed:
            self._changed.wait_for(lambda: self._arrived or self._lost, within_s)
            taken = list(self._arrived)
            self._arrived.clear()
        self._check()
        return taken

    def acknowledge(self, messages: Sequence[paho.MQTTMessage]) -> None:
        """Let the broker forget messages."""
        for message in messages:
            self._client.ack(message.mid, message.qos)

    def close(self) -> None:
        """Let go; the broker keeps the session."""
        with contextlib.suppress(OSError, ValueError):
            self._client.disconnect()
        self._client.loop_stop()

    def _check(self) -> None:
        if self._lost:
            raise SinkError(f"{self._where}: {self._lost}")

    # --- in the library's thread -----------------------------------------------------------

    def _on_connect(self, client: paho.Client, _data: Any, _flags: Any, code: ReasonCode, _properties: Any) -> None:
        if code.is_failure:
            self._tell_lost(reason(code.value, str(code)))
        else:
            client.subscribe(f"{self._config.topic}/+/history/+", qos=1)

    def _on_subscribe(self, _client: Any, _data: Any, _mid: int, codes: list[ReasonCode], _properties: Any) -> None:
        refused = next((code for code in codes if code.is_failure), None)
        if refused is not None:
            self._tell_lost(f"`user_name` may not read {self._config.topic}/+/history/+: {refused}")
        with self._changed:
            self._subscribed = refused is None
            self._changed.notify_all()

    def _on_disconnect(self, _client: Any, _data: Any, _flags: Any, code: ReasonCode, _properties: Any) -> None:
        self._tell_lost(lost(code.value, str(code)) if self._subscribed else closed_at_once(self._config))

    def _on_message(self, _client: Any, _data: Any, message: paho.MQTTMessage) -> None:
        if message.qos == 0:
            return  # no row of a sink, and the broker would send them without end while the database is slow
        with self._changed:
            self._subscribed = True  # by the session that the broker kept, whose rows come before it answers
            self._arrived.append(message)
            self._changed.notify_all()

    def _tell_lost(self, why: str) -> None:
        with self._changed:
            self._lost = self._lost or why
            self._changed.notify_all()


class _LeftOut:
    """Messages that are no rows, or that the database does not take: all are counted, some a minute named in the log.

    A publisher of another version would else fill the disk with a line per message.
    """

    def __init__(self) -> None:
        self.count, self.last = 0, ""
        self._since_s, self._named, self._unnamed = float("-inf"), 0, 0

    def add(self, whose: str, problem: str) -> None:
        self.count, self.last = self.count + 1, f"{printable(whose)[:LONGEST_PROBLEM]}: {problem}"
        if (now_s := time.monotonic()) - self._since_s >= LEFT_OUT_PERIOD_S:
            self._since_s, self._named = now_s, 0
        if self._named >= LEFT_OUT_NAMED:
            self._unnamed += 1
            return
        log.warning("store.refused", problem=self.last, unnamed_before=self._unnamed)
        self._named, self._unnamed = self._named + 1, 0


class PlantStore:
    """Takes from a broker and stores until it is told to stop, however often that fails."""

    def __init__(
        self,
        config: PlantStoreConfig,
        stop: threading.Event,
        tell: Callable[[str], None] = lambda _status: None,
        kept: Path | None = None,
    ) -> None:
        """`tell` gets a sentence now and then while it works, on what it does or what keeps it from that.

        `kept` is the file that says to the next run what was put there, so that it notices a database that was
        restored meanwhile.
        """
        self._config, self._stop, self._tell = config, stop, tell
        self._told_s, self._taken, self._left_out = float("-inf"), 0, _LeftOut()
        self._retry = Retry()
        self._said = ""
        self._same_name = SameName()
        self._kept = kept
        self._newest: Newest = {} if kept is None else _read_kept(kept)
        self._known = dict(self._newest)
        self._looked_s = time.monotonic()
        self._less: list[str] = []
        """Machines of which the database has lost what was put there."""

    def run(self) -> None:
        """Work until stopped."""
        while not self._stop.is_set():
            try:
                self._session()
            except SinkError as error:
                if str(error) != self._said:
                    log.warning("store.failed", problem=str(error))
                self._said = str(error)
                self._tell(f"cannot store, tries again: {self._said}")
                self._stop.wait(self._retry.after_failure())

    def _session(self) -> None:
        there = self._config.postgresql
        where = f"database {there.host}:{there.port}/{there.database}"
        database, subscription = Database(there, where, STORE), Subscription(self._config.mqtt)
        self._same_name = SameName()  # what was not acknowledged comes again, in its order
        try:
            self._open(database)
            self._look_for_less(database)
            subscription.open()
            log.info("store.works", broker=self._config.mqtt.host, database=there.host)
            while not self._stop.is_set():
                self._works()
                if messages := subscription.take(LOOK_PERIOD_S):
                    self._store(database, messages)
                    subscription.acknowledge(messages)
                    self._retry.works()
                    self._said = ""
                if time.monotonic() - self._looked_s >= LESS_PERIOD_S:
                    self._look_for_less(database)
        finally:
            self._keep()
            subscription.close()
            database.close()

    def _keep(self) -> None:
        """Write the newest times for the next run where they have changed; what was lost with a database goes on."""
        if self._kept is None or not self._newest or self._newest == self._known:
            return
        self._known = dict(self._newest)
        try:
            write_whole(self._kept, json.dumps([[*key, ms] for key, ms in sorted(self._known.items())]), 0o600)
        except OSError as error:
            log.warning("store.unwritten", path=str(self._kept), problem=str(error))

    def _open(self, database: Database) -> None:
        """Open the database; the service manager would end a process that says nothing while its tables change."""
        opened = threading.Event()

        def tell() -> None:
            while not opened.wait(TELL_PERIOD_S):
                self._tell("opens the database; where a new version changes its tables, that may take long")

        thread = threading.Thread(target=tell, name="opening", daemon=True)
        thread.start()
        try:
            database.open()
        finally:
            opened.set()
            thread.join()

    def _look_for_less(self, database: Database) -> None:
        """Notice a database that was restored: the broker does not have again what that one lost.

        What a machine's own sink sends there too is that one's to notice.
        """
        self._looked_s = time.monotonic()
        try:
            found = database.connection.execute(
                "SELECT machine, stream, "
                "CASE generation WHEN '' THEN round(extract(epoch FROM newest) * 1000)::bigint END "
                "FROM toolpoint.deliveries"
            ).fetchall()
        except (psycopg.Error, OSError) as error:
            raise database.refused(error) from error
        there = {(machine, stream): math.inf if ms is None else ms for machine, stream, ms in found}
        lost = {key[0] for key, ms in self._newest.items() if there.get(key, -math.inf) < ms}
        if lost:
            self._newest = {}
            self._less = sorted(lost.union(self._less))
            log.error("store.less", problem=less_than_stored(self._less))
        self._keep()

    def _works(self) -> None:
        if time.monotonic() - self._told_s >= TELL_PERIOD_S:
            self._told_s = time.monotonic()
            came = f"{self._taken} messages since the start"
            if self._left_out.count:
                came += f"; {left_out(self._left_out.count, self._left_out.last)}"
            topic = f"{self._config.mqtt.topic}/+/history/+"
            none = (
                f"no message has come yet: see that machines publish, and that the broker lets `user_name` read {topic}"
            )
            again = f"; {two_computers(names)}" if (names := self._same_name.names()) else ""
            less = f"; {less_than_stored(self._less)}" if self._less else ""
            self._tell(f"stores; {came if self._taken else none}{again}{less}")

    def _store(self, database: Database, messages: Sequence[paho.MQTTMessage]) -> None:
        """Commit the rows of messages; one that the database does not take is named and left out."""
        rows = [row for message in messages if (row := self._row(message)) is not None]
        try:
            try:
                self._newest.update(_put(database, rows))
            except FAULTS_OF_A_ROW:
                for row in rows:
                    self._works()
                    self._put_alone(database, row)
        except (psycopg.Error, OSError) as error:
            raise database.refused(error) from error
        self._taken += len(messages)

    def _row(self, message: paho.MQTTMessage) -> StoredRow | None:
        topic = ""
        try:
            topic = message.topic  # which brokers other than mosquitto pass on with bytes that are no text
            row = row_of(topic, bytes(message.payload), self._config.mqtt.topic)
        except (ValueError, RecursionError) as error:
            self._left_out.add(topic, _said(error))
            return None
        self._same_name.saw(row.machine, _store_of(message))
        return row

    def _put_alone(self, database: Database, row: StoredRow) -> None:
        try:
            _put(database, [row])
        except FAULTS_OF_A_ROW as error:
            column = error.diag.column_name
            if isinstance(error, errors.NotNullViolation) and column not in row.stream.columns:
                raise  # a column of somebody's own, which no row has: they wait
            self._left_out.add(f"{row.stream.name} of {row.machine}", _said(error))


def _read_kept(path: Path) -> Newest:
    """Return what a file of an earlier run says; nothing where there is none that can be read."""
    try:
        return {(str(machine), str(stream)): int(ms) for machine, stream, ms in json.loads(read_whole(path))}
    except (OSError, ValueError, TypeError, RecursionError):
        return {}


def store_status(config: PlantStoreConfig) -> dict[str, Any]:
    """Return whether a store is connected to the database, and how late each machine's newest row is [s].

    By the database's clock; a row of a clock that is ahead is as late as its delivery. Raises SinkError.
    """
    there = config.postgresql
    database = Database(there, f"database {there.host}:{there.port}/{there.database}", "toolpoint store status")
    try:
        database.open()
        ask = database.connection.execute
        (running,) = ask(
            "SELECT count(*) > 0 FROM pg_stat_activity WHERE application_name = %s AND datname = current_database()",
            (STORE,),
        ).fetchone() or (False,)
        found = ask(
            "SELECT machine, extract(epoch FROM max(newest))::float8, "
            "extract(epoch FROM greatest(max(delivered), max(stored)))::float8, "
            "extract(epoch FROM now() - least(max(newest), greatest(max(delivered), max(stored))))::float8 "
            "FROM toolpoint.deliveries GROUP BY machine ORDER BY machine"
        ).fetchall()
    except (psycopg.Error, OSError) as error:
        raise database.refused(error) from error
    finally:
        database.close()
    names = ("machine", "newest_utc_s", "stored_utc_s", "late_s")
    return {"running": running, "machines": [dict(zip(names, row, strict=True)) for row in found]}


def _store_of(message: paho.MQTTMessage) -> str:
    """Return the machine's store of which a row is; '' where an earlier version has sent it."""
    return str(dict(getattr(message.properties, "UserProperty", ())).get(STORE_PROPERTY, ""))


def _said(error: Exception) -> str:
    """Return an error on one line of bounded length: it may repeat what came from the broker."""
    return printable(" ".join(str(error).split()))[:LONGEST_PROBLEM]


def _put(database: Database, rows: Sequence[StoredRow]) -> Newest:
    """Commit rows; return the newest time of each machine and stream among them."""
    of_stream: dict[str, list[StoredRow]] = {}
    newest: Newest = {}
    for row in rows:
        of_stream.setdefault(row.stream.name, []).append(row)
        key = row.machine, row.stream.name
        newest[key] = max(row.utc_ms, newest.get(key, row.utc_ms))
    some_of = [(stream, of_stream[name]) for name, stream in STREAMS.items() if name in of_stream]
    days_of = [{row.utc_ms // DAY_MS for row in some} for _, some in some_of]
    with database.transaction() as connection:
        for (stream, _), days in zip(some_of, days_of, strict=True):
            database.make_months(stream, days)
        for (stream, some), days in zip(some_of, days_of, strict=True):
            database.put(stream, ((row.machine, *row.values) for row in some), days)
        with connection.cursor() as cursor:
            # Generation, positions and `delivered` are those of a sink that sends to the database itself, where a
            # machine has one.
            cursor.executemany(
                "INSERT INTO deliveries (machine, stream, generation, last_row, last_chunk, newest, stored) "
                "VALUES (%s, %s, '', 0, 0, %s, now()) ON CONFLICT (machine, stream) DO UPDATE SET "
                "newest = greatest(deliveries.newest, excluded.newest), stored = now()",
                [(machine, stream, time_of(ms)) for (machine, stream), ms in sorted(newest.items())],
            )
    return newest
