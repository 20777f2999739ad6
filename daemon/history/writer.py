"""The store's only writer. Every method returns at once; the commits happen in its thread."""

import json
import sqlite3
import time
from collections import Counter
from collections.abc import Callable, Generator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from config.schema.service import HistoryConfig
from daemon.history import rows
from daemon.history.database import HistoryError, OlderStoreError, connect_writer
from daemon.history.engine import Engine, cause_in_words
from daemon.history.intake import Commit, Entry, Execute, Intake, LayoutIds
from daemon.history.layout import MachineLayout
from daemon.history.restart_reader import RestartReader
from daemon.history.retention import HousekeepingReport
from daemon.history.series import WriteRecord
from daemon.history.store_lock import WriterLock
from daemon.history.tidying import Housekeeping
from drivers.clock import Clock
from models.json_values import printable
from models.records import (
    OF_SOURCE,
    CncSample,
    CompensationCommand,
    DisplacementSample,
    MachineTemperatures,
    ProbeSample,
    Receipt,
    Reference,
    TemperatureCycle,
    ThermalErrorEstimate,
    Trace,
)

CYCLE_COMMIT_S = 0.05
"""A cycle waits this long for its estimate and write, so that one commit carries all of them."""
AUDIT_COMMIT_S = 0.02
"""A record of the audit waits this long for the next, so that one commit carries both."""
SAMPLE_COMMIT_S = 10.0
"""Samples wait for a cycle's commit, but no longer than this; so does an intent that is kept outside the store, for
the commit of its cycle or of its outcome: to tell the thread about it would hold the write up."""
CLOSE_WITHIN_S = 10.0
STUCK_S = 10.0
"""A commit that has not returned after this may never [s of the wall clock]."""
QUEUE_LIMIT = 50_000
"""Records that wait while the disk fails: some five hours, about 50 MB."""

T = TypeVar("T")
Build = Callable[[], rows.Parameters]


class WriteId(int):
    """Number of a write in the audit; awaiting it waits for the commit of the intent."""

    commit: Commit

    def __new__(cls, number: int, commit: Commit) -> "WriteId":
        write_id = super().__new__(cls, number)
        write_id.commit = commit
        return write_id

    def __await__(self) -> Generator[Any, None, int]:
        yield from self.commit.__await__()
        return int(self)


class HistoryWriter:
    """Queues records from any thread and commits them in groups.

    The callbacks run in the writer's thread: `on_acknowledged(line, number)` after the commit that
    holds the cycle has returned, `on_problem(sentence)` when the store cannot be written, and
    `on_problem("")` when it works again. What one of the `sinks` has not taken yet is kept longer.
    """

    def __init__(
        self,
        path: Path,
        *,
        clock: Clock,
        machine: MachineLayout,
        on_acknowledged: Callable[[str, int], None] = lambda _line, _number: None,
        on_problem: Callable[[str], None] = lambda _problem: None,
        queue_limit: int = QUEUE_LIMIT,
        sinks: Sequence[str] = (),
    ) -> None:
        self.path = path
        self._clock = clock
        self._machine = machine
        self._intake = Intake(queue_limit)
        self._lock = WriterLock(path)
        self._engine = Engine(
            path,
            self._intake,
            machine,
            self._lock,
            on_acknowledged=on_acknowledged,
            on_problem=on_problem,
            on_lost=lambda sentence: self.event("history", sentence, "daemon"),
            kept=self._kept_states,
        )
        self._state: dict[str, str] = {}
        self._last_displacement_utc_s: float | None = None
        self._write_id: int | None = None
        self.housekeeping = Housekeeping(self, sinks, self._engine.report)

    # --- life ----------------------------------------------------------------------------

    def hold(self) -> None:
        """Keep other writers away from now on, so that what is read here is what `start` goes on from."""
        self._lock.acquire()

    def start(self) -> None:
        """Open the store and start the thread; raises HistoryError where the store must not be written."""
        self._lock.acquire()
        self._engine.start()
        if self._engine.refusal is not None:
            self._lock.release()
            raise self._engine.refusal

    def close(self) -> None:
        """Write what is queued, close the store; blocks, at most some seconds."""
        if self._engine.stop(CLOSE_WITHIN_S):
            self._lock.release()

    async def flushed(self) -> None:
        """Return when everything that was queued before is committed."""
        await self.submit(lambda _connection: None)

    @property
    def waiting(self) -> int:
        """Records that are not yet committed."""
        return len(self._intake)

    @property
    def dropped(self) -> Counter[str]:
        """Records that were given up, by kind."""
        return self._intake.dropped.copy()

    @property
    def problem(self) -> str:
        """What keeps the store from being written, in words; empty when nothing does."""
        if time.monotonic() - self._engine.attempted_s > STUCK_S:
            return (
                f"{self.path}: the disk has not answered for {STUCK_S:g} s. Records wait in memory and are written "
                "when it does; compensation goes on"
            )
        return self._engine.problem

    # --- measurements --------------------------------------------------------------------

    def temperatures(self, cleansed: MachineTemperatures | None, cycle: TemperatureCycle) -> None:
        """Record a line cycle as measured, with the quality that cleansing gave each value."""
        if cycle.line not in self._machine.lines:
            raise ValueError(f"line {cycle.line!r} is not one of this machine's: {sorted(self._machine.lines)}")

        def execute(connection: sqlite3.Connection, layout_ids: LayoutIds) -> None:
            parameters, layout = rows.cycle_row(self._machine, cycle, cleansed)
            connection.execute(rows.INSERT_CYCLE, (layout_ids[layout], *parameters))

        acknowledges = (cycle.line, cycle.number, rows.utc_ms(cycle.trace.first_byte))
        entry = Entry(kind="temperature cycles", execute=execute, bulk=True, acknowledges=acknowledges)
        self._intake.put(entry, within_s=CYCLE_COMMIT_S)

    def cnc_sample(self, sample: CncSample) -> None:
        """Record a poll of the CNC, with the next cycle's commit."""
        self._sample("CNC samples", rows.INSERT_CNC, partial(rows.cnc_row, self._machine, sample))

    def displacement(self, sample: DisplacementSample) -> None:
        """Record a row of the logger's file or of another source."""
        if sample.um.size != len(self._machine.displacement_channels):
            raise ValueError(
                f"{sample.source}: {sample.um.size} displacements, the configuration has the channels "
                f"{list(self._machine.displacement_channels)}"
            )
        if not sample.source.startswith(OF_SOURCE):
            self._last_displacement_utc_s = sample.utc_s
        build = partial(rows.displacement_row, self._machine, sample)
        self._sample("displacements", rows.INSERT_DISPLACEMENT, build)

    def estimate(self, estimate: ThermalErrorEstimate) -> None:
        """Record an estimate, with its cycle's commit."""
        self._sample("estimates", rows.INSERT_ESTIMATE, partial(rows.estimate_row, estimate))

    def _sample(self, kind: str, sql: str, build: Build) -> None:
        self._intake.put(Entry(kind=kind, execute=_statement(sql, build), bulk=True), within_s=SAMPLE_COMMIT_S)

    # --- audit ---------------------------------------------------------------------------

    def write_intent(
        self,
        command: CompensationCommand | None,
        macros: Sequence[tuple[int, float]],
        cause: str,
        person: str | None = None,
        *,
        kept: bool = False,
        number: int | None = None,
    ) -> WriteId:
        """Record what is about to be written; the write's number goes to `write_outcome`.

        `kept`: the intent survives the process without the store, whose thread leaves the computer to the write.
        `number`: of a write of the previous run that was kept and never came here.
        """
        self._write_id = self._next_write_id() if number is None else number
        build = partial(rows.intent_row, self._write_id, self._clock.now(), command, tuple(macros), cause, person)
        within_s = SAMPLE_COMMIT_S if kept else 0.0
        return WriteId(self._write_id, self._audit("write intents", rows.INSERT_INTENT, build, within_s=within_s))

    def write_outcome(self, write_id: int, receipt: Receipt) -> Commit:
        build = partial(rows.outcome_row, self._machine, int(write_id), self._clock.now(), receipt)
        return self._audit("write outcomes", rows.UPDATE_OUTCOME, build)

    def write_echoed(self, write_id: int, trace: Trace) -> Commit:
        """Record that the guard has taken over what the cycle behind a write led to."""
        return self._audit("write echoes", rows.UPDATE_ECHOED, partial(rows.echoed_row, write_id, trace))

    def event(self, kind: str, text: str, person: str | None = None) -> Commit:
        """Record an operator's action, a change of state, an alarm."""
        return self._audit("events", rows.INSERT_EVENT, partial(rows.event_row, self._clock.now(), kind, text, person))

    def probe(self, probe: ProbeSample) -> Commit:
        """Record a probe value, taken or refused."""
        return self._audit("probes", rows.INSERT_PROBE, partial(rows.probe_row, probe))

    def reference(self, reference: Reference) -> Commit:
        def execute(connection: sqlite3.Connection, layout_ids: LayoutIds) -> None:
            before, after = rows.reference_row(reference)
            connection.execute(rows.INSERT_REFERENCE, (*before, layout_ids[self._machine.machine], *after))

        return self._put("references", execute)

    def put_state(self, key: str, value: Any, text: str = "") -> Commit:
        """Keep a JSON value for the next start of the daemon, or the `text` that it has."""
        text, time_ms = text or json.dumps(value, allow_nan=False), rows.utc_ms(self._clock.now())
        self._state[key] = text
        return self._audit("states", rows.PUT_STATE, lambda: (key, text, time_ms))

    def _kept_states(self) -> list[tuple[str, str, int]]:
        """Return the states of this run, for a store that is begun anew."""
        now_ms = rows.utc_ms(self._clock.now())
        return [(key, text, now_ms) for key, text in list(self._state.items()) if text != "null"]

    def _audit(self, kind: str, sql: str, build: Build, *, within_s: float = AUDIT_COMMIT_S) -> Commit:
        return self._put(kind, _statement(sql, build), within_s=within_s)

    def _put(self, kind: str, execute: Execute, *, within_s: float = AUDIT_COMMIT_S) -> Commit:
        entry = Entry(kind=kind, execute=execute)
        self._intake.put(entry, within_s=within_s)
        return entry.commit

    def _next_write_id(self) -> int:
        if self._write_id is None:
            known = self._engine.last_write_id
            # A store that could not be opened yet does not tell its last number: start above any.
            return 1 + (rows.utc_ms(self._clock.now()) if known is None else known)
        return self._write_id + 1

    # --- what an earlier run left --------------------------------------------------------

    def get_state(self, key: str) -> Any:
        """Return a value that `put_state` kept, None where there is none. May be called before `start`."""
        if key not in self._state:
            self._state[key] = json.dumps(self._look_up(lambda reader: reader.get_state(key)))
        return json.loads(self._state[key])

    def last_written_macros(self, of: Sequence[int] = ()) -> dict[int, tuple[float, ...]] | None:
        """Return what our macros, or `of` these, may hold by the audit; None when nothing was ever written."""
        return self._look_up(lambda reader: reader.last_written_macros(of))

    def last_write_id(self) -> int | None:
        """Return the number of the newest write in the audit; None when nothing was ever written."""
        return self._look_up(lambda reader: reader.last_write_id())

    def unsettled_writes(self) -> list[WriteRecord]:
        """Return the intents of earlier runs whose outcome is not known."""
        return self._look_up(lambda reader: reader.unsettled_writes()) or []

    def last_displacement_utc_s(self) -> float | None:
        """Return the time of the newest displacement of a file, so that it is not read twice."""
        if self._last_displacement_utc_s is None:
            self._last_displacement_utc_s = self._look_up(lambda reader: reader.last_displacement_utc_s())
        return self._last_displacement_utc_s

    def _look_up(self, question: Callable[[RestartReader], T]) -> T | None:
        if not self.path.is_file() or self.path.stat().st_size == 0:
            return None
        try:
            try:
                reader = RestartReader(self.path, also_on_full_disk=True)
            except OlderStoreError:
                self._lock.acquire()
                connect_writer(self.path).close()
                reader = RestartReader(self.path, also_on_full_disk=True)
            with reader:
                return question(reader)
        except sqlite3.Error as error:
            raise HistoryError(f"{self.path}: {cause_in_words(error)}") from error

    # --- jobs ----------------------------------------------------------------------------

    def submit(self, job: Callable[[sqlite3.Connection], object]) -> Commit:
        """Run a job on the writing connection, between two commits; keep it short. The commit holds its result."""
        entry = Entry(kind="jobs", execute=lambda connection, _: job(connection), is_job=True)
        self._intake.put(entry, within_s=0.0)
        return entry.commit

    async def request_housekeeping(self, config: HistoryConfig) -> HousekeepingReport | None:
        """Pack and prune; the packing itself runs in a process of its own. None while that goes on already."""
        return await self.housekeeping.run(config, self._clock.now().utc_s)


def _statement(sql: str, build: Build) -> Execute:
    def execute(connection: sqlite3.Connection, _layout_ids: LayoutIds) -> None:
        connection.execute(sql, [printable(p, keep="\n") if isinstance(p, str) else p for p in build()])

    return execute
