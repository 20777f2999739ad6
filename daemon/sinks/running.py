"""Runs the sinks, each in a thread of its own: what one of them waits for keeps no other back."""

import contextlib
import errno
import fcntl
import sqlite3
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import structlog

from config.schema import Configuration
from config.schema.sinks import SinkConfig
from daemon.history.cursors import Cursor, Position, cursor_path
from daemon.history.database import HistoryError
from daemon.sinks.contract import Progress, Retry, Sink, SinkError, SinkWaitsError, Watch
from daemon.sinks.outbox import STREAMS, Outbox
from daemon.sinks.watching import lock_path, runs, silence

if TYPE_CHECKING:
    from daemon.sinks.alarms.message import Messenger

log = structlog.get_logger(__name__)
ALIVE_PERIOD_S = 30.0
"""How often a sink with nothing to send says that it runs."""
LOCK_WITHIN_S = 0.5
"""Somebody who looks whether the process runs holds its lock for a moment; another such process for longer."""
LOOK_ANYWAY_S = 5.0
"""A store whose files are as they were is looked at all the same when the last look is so long ago."""
STOP_WITHIN_S = 10.0
TELL_PERIOD_S = 5.0
OpenSink = Callable[[SinkConfig, str], Sink]
Files = tuple[tuple[int, int, int] | None, ...]
"""Number, size and time of change of a store's files; None where there is none."""


def make_sink(config: SinkConfig, machine: str) -> Sink:
    """Return the sink that a section describes; its library is loaded here."""
    if config.driver == "parquet":
        try:
            from daemon.sinks.parquet import ParquetSink  # noqa: PLC0415
        except ImportError as error:
            raise SinkError(
                f"sink {config.name}: needs pyarrow, which is missing: install toolpoint[parquet]"
            ) from error

        return ParquetSink(config, machine)
    if config.driver == "mqtt":
        from daemon.sinks.mqtt import MqttSink  # noqa: PLC0415

        return MqttSink(config, machine)
    if config.driver == "sparkplug":
        try:
            from daemon.sinks.sparkplug import SparkplugSink  # noqa: PLC0415
        except ImportError as error:
            raise SinkError(
                f"sink {config.name}: needs protobuf, which is missing: install toolpoint[sparkplug]"
            ) from error

        return SparkplugSink(config, machine)
    from daemon.sinks.postgresql import PostgresqlSink  # noqa: PLC0415

    return PostgresqlSink(config, machine)


def make_messenger(config: SinkConfig) -> "Messenger":
    """Return what brings alarms to people."""
    from daemon.sinks.alarms.mail import MailMessenger  # noqa: PLC0415
    from daemon.sinks.alarms.webhook import WebhookMessenger  # noqa: PLC0415

    return WebhookMessenger(config) if config.driver == "webhook" else MailMessenger(config)


def opener(config: SinkConfig, configuration: Configuration) -> OpenSink:
    """Return what makes a sink; that of alarms looks at the whole machine."""
    if config.alarms is None:
        return make_sink

    def make_alarm_sink(config: SinkConfig, _machine: str) -> Sink:
        from daemon.sinks.alarms.sink import AlarmSink  # noqa: PLC0415

        return AlarmSink(config, configuration, make_messenger(config))

    return make_alarm_sink


class SinkRunner:
    """Sends what waits to one sink until it is told to stop, however often that fails."""

    def __init__(
        self,
        config: SinkConfig,
        store: Path,
        machine: str,
        stop: threading.Event,
        open_sink: OpenSink = make_sink,
        wait: Callable[[float], object] | None = None,
    ) -> None:
        """`wait` lets time pass; without it the computer's, cut short by `stop`."""
        self._config, self._store, self._machine = config, store, machine
        self._stop, self._open_sink = stop, open_sink
        self._wait = wait or stop.wait
        self._path = cursor_path(store, config.name)
        self._retry = Retry()
        self._said = ""
        self._progress = Progress(cursor=Cursor.read(self._path) or Cursor(), save=self._save)

    @property
    def cursor(self) -> Cursor:
        return self._progress.cursor

    def run(self) -> None:
        """Work until stopped."""
        while not self._stop.is_set():
            try:
                self._session()
            except (SinkError, HistoryError) as error:
                self._failed(str(error))
            except (OSError, sqlite3.Error) as error:
                self._failed(f"sink {self._config.name}: {error}")
            except Exception as error:
                log.exception("sink.defect", sink=self._config.name)
                self._failed(f"sink {self._config.name}: unexpected {type(error).__name__}: {error}")

    def _session(self) -> None:
        """Connect, then send until something fails or the end."""
        if self._config.alarms is None:
            with Outbox(self._store) as outbox:
                self._begin_anew_where_needed(outbox)
        sink = self._open_sink(self._config, self._machine)
        try:
            there = dict(sink.open(self.cursor))
            self._progress.cursor = replace(self.cursor, positions=there)
            all_taken_of: Files | None = None
            looked_s = 0.0
            while not self._stop.is_set():
                files, now_s, more = _files(self._store), time.monotonic(), False
                if sink.needs_rows() and files == all_taken_of and now_s - looked_s < LOOK_ANYWAY_S:
                    self._wait(self._config.period_s)
                    continue
                all_taken_of, looked_s = None, now_s
                try:
                    with Outbox(self._store) as outbox:
                        self._begin_anew_where_needed(outbox)
                        more = sink.transfer(outbox, self._progress)
                except SinkWaitsError as waits:
                    self._retry.works()
                    self._note(str(waits))
                except (HistoryError, sqlite3.Error) as error:
                    if not isinstance(sink, Watch):
                        raise
                    self._note(f"sink {self._config.name}: what happens is not told: {error}")
                    sink.look_on()
                else:
                    self._went_well()
                    all_taken_of = None if more else files
                if not more:
                    self._wait(self._config.period_s)
        finally:
            sink.close()

    def _begin_anew_where_needed(self, outbox: Outbox) -> None:
        """Send everything again from a store that was begun anew, restored, or is an older copy."""
        generation, cursor = outbox.generation(), self.cursor
        positions = dict(cursor.positions) if cursor.generation == generation else {}
        for name, stream in STREAMS.items():
            positions[name] = outbox.start(stream, positions.get(name, Position()))
        if cursor.generation != generation or positions != cursor.positions:
            self._progress.cursor = replace(cursor, generation=generation, positions=positions)

    def _save(self, cursor: Cursor) -> None:
        now_utc_s = time.time()
        self._progress.cursor = replace(cursor, acknowledged_utc_s=now_utc_s, alive_utc_s=now_utc_s, problem="")
        self.cursor.write(self._path)

    def _went_well(self) -> None:
        self._retry.works()
        if self.cursor.problem or not self._spoke_lately():
            self._progress.cursor = replace(self.cursor, problem="", alive_utc_s=time.time())
            self.cursor.write(self._path)
        if self._said:
            log.info("sink.works_again", sink=self._config.name)
            self._said = ""

    def _spoke_lately(self) -> bool:
        return 0.0 <= time.time() - self.cursor.alive_utc_s < ALIVE_PERIOD_S

    def _failed(self, problem: str) -> None:
        self._note(problem)
        self._wait(self._retry.after_failure())
        self._note(problem)  # again: this wait and the next try together are longer than a process may be silent

    def _note(self, problem: str) -> None:
        """Say in the cursor and, where it is new, in the log why nothing is sent."""
        new, self._said = problem != self._said, problem
        if new:
            log.warning("sink.failed", sink=self._config.name, problem=problem)
        if problem == self.cursor.problem and self._spoke_lately():
            return
        self._progress.cursor = replace(self.cursor, problem=problem, alive_utc_s=time.time())
        try:
            self.cursor.write(self._path)
        except OSError as error:
            if new:
                log.error("sink.cursor", path=str(self._path), problem=str(error))


def _files(store: Path) -> Files:
    """Return what changes with every row that is committed to a store."""
    found: list[tuple[int, int, int] | None] = []
    for path in (store, store.with_name(f"{store.name}-wal")):
        try:
            status = path.stat()
        except OSError:
            found.append(None)
        else:
            found.append((status.st_ino, status.st_size, status.st_mtime_ns))
    return tuple(found)


@contextlib.contextmanager
def alone(store: Path) -> Iterator[None]:
    """Be the one process that sends a store; raises HistoryError when another does."""
    folder = cursor_path(store, "").parent
    try:
        folder.mkdir(parents=True, exist_ok=True)
        try:
            lock = lock_path(store).open("a")
        except OSError as error:
            if error.errno != errno.EROFS:
                raise
            lock = lock_path(store).open()  # people are told of a disk that takes nothing, too
    except OSError as error:
        raise HistoryError(f"{folder}: cannot be written ({error.strerror}); run this as the daemon's user") from error
    with lock:
        until_s = time.monotonic() + LOCK_WITHIN_S
        while True:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError as error:
                if time.monotonic() > until_s:
                    raise HistoryError(
                        f"{store}: another process sends this store to its sinks; stop that one first"
                    ) from error
                time.sleep(LOCK_WITHIN_S / 10.0)
        yield


def run_sinks(
    configuration: Configuration, stop: threading.Event, tell: Callable[[str], None] = lambda _status: None
) -> None:
    """Run every sink of a configuration until `stop` is set; raises HistoryError when another process does.

    `tell` hears every few seconds what keeps them from sending.
    """
    store = configuration.history.path
    with alone(store):
        runners = [
            SinkRunner(each, store, configuration.machine, stop, opener(each, configuration))
            for each in configuration.sinks or ()
        ]
        threads = [threading.Thread(target=each.run, name="sink", daemon=True) for each in runners]
        for thread in threads:
            thread.start()
        while not stop.wait(TELL_PERIOD_S):
            tell("; ".join(filter(None, (each.cursor.problem for each in runners))) or "sending")
        for thread in threads:
            thread.join(STOP_WITHIN_S)


def sink_status(configuration: Configuration, now_utc_s: float) -> list[dict[str, Any]]:
    """Return per sink what it has taken, what waits for it, and what keeps it from taking more."""
    return [_status(configuration, each, now_utc_s) for each in configuration.sinks or ()]


def _status(configuration: Configuration, config: SinkConfig, now_utc_s: float) -> dict[str, Any]:
    path = cursor_path(configuration.history.path, config.name)
    cursor = Cursor.read(path) or Cursor()
    with Outbox(configuration.history.path) as outbox:
        same = cursor.generation == outbox.generation()
        positions = cursor.positions if same else {}
        streams = STREAMS if config.alarms is None else {}
        found = {name: outbox.waiting(each, positions.get(name, Position())) for name, each in streams.items()}
    store = configuration.history.path
    running = runs(store)
    oldest = [time_s for _, time_s in found.values() if time_s is not None]
    return {
        "name": config.name,
        "driver": config.driver,
        "place": config.place,
        "exposed": config.exposed,
        "running": running,
        "problem": cursor.problem or (silence(config.name, store, cursor.alive_utc_s, now_utc_s) if running else ""),
        "acknowledged_utc_s": cursor.acknowledged_utc_s,
        "counted": "rows" if config.alarms is None else "messages",
        "rows": {
            "sent": cursor.sent_rows,
            "stored": cursor.stored_rows,
            "repeated": cursor.sent_rows - cursor.stored_rows,
            "waiting": {name: count for name, (count, _) in found.items() if count},
        },
        "oldest_waiting_utc_s": min(oldest, default=None),
        "newest_utc_s": dict(cursor.newest_utc_s),
    }
