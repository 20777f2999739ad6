"""The sink of alarms: looks at the events of the history and at the machine, and tells people what is due.

What was told, and how far the events were read, stands in one file beside the cursor, which is written before a message
goes out and after it was taken: over a restart nothing is lost, and what was not acknowledged is told once more with
the same number. Where it cannot be written people are told all the same, and after a restart once more. It holds no
rows back: the retention of the history does not wait for it.
"""

import os
import re
import sqlite3
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import structlog
from pydantic import TypeAdapter

from config.files import read_whole
from config.schema import Configuration
from config.schema.sinks import AlarmsConfig, SinkConfig
from daemon.history.cursors import Cursor, Position, cursor_path
from daemon.history.database import HistoryError
from daemon.sinks.alarms.ledger import Condition, Ledger, Limits
from daemon.sinks.alarms.message import Message, Messenger, UnansweredError
from daemon.sinks.alarms.observing import OF_STATUS, Lasting, asked, of_computer, of_status, worn_models
from daemon.sinks.contract import Progress, SinkWaitsError
from daemon.sinks.outbox import STREAMS, Outbox
from models.errors import RefusedInputError
from models.records import OutputState

log = structlog.get_logger(__name__)
LOOK_S = 10.0
"""How often the daemon is asked."""
COMPUTER_S = 600.0
"""How often disk and certificates are looked at."""
SHARE_WITHIN_S = 5.0
"""So long that look is waited for: a folder on a network share may not answer for hours."""
MODELS_S = 86_400.0
"""How often it is looked whether a model wears out."""
EARLIER_ROWS = 5000
"""So many latest events say where the output is when an alarm sink begins."""
EVENTS = STREAMS["events"]


CHANGE = re.compile(r"(\w+) -> (\w+): (.*)", re.DOTALL)
START = re.compile(r"(\w+): (.*)", re.DOTALL)
SETTLED_S = 30.0
"""A start of the daemon counts when no change follows for so long: a latched FAULT comes right after it."""
ALARMING = (OutputState.FAULT, OutputState.HOLD)


@dataclass(frozen=True, slots=True, kw_only=True)
class Stay:
    """A stay of the output in one state."""

    state: str
    since_utc_s: float
    reason: str
    reasons: int = 1


@dataclass(frozen=True, slots=True, kw_only=True)
class OutputTrack:
    now: Stay | None = None
    """None: nothing is known yet."""
    faults: tuple[str, ...] = ()
    """Reasons of the latched FAULT."""
    started: Stay | None = None
    """What the daemon began with, while that may change at once."""

    def after(self, utc_s: float, kind: str, text: str) -> tuple["OutputTrack", tuple[Stay, ...]]:
        """Return the track after an event, and the stays that have ended."""
        if kind == "fault":
            faults = tuple(dict.fromkeys((*self.faults, text)))  # after a restoration the daemon finds it once more
            if self.now is None or self.now.state != OutputState.FAULT:
                return replace(self, faults=faults), ()
            now = replace(self.now, reason="; ".join(faults), reasons=len(faults))
            return replace(self, faults=faults, now=now), ()
        if kind == "start" and (match := START.fullmatch(text)):
            track, ended = self.settled(utc_s)
            return replace(track, started=_stay(match[1], utc_s, match[2])), ended
        if kind == "state" and (match := CHANGE.fullmatch(text)):
            track, ended = self.settled(utc_s)
            track, left = track._to(_stay(match[2], utc_s, match[3]))
            return track, (*ended, *left)
        return self, ()

    def settled(self, utc_s: float) -> tuple["OutputTrack", tuple[Stay, ...]]:
        """Return the track at a time, and the stay that a start of the daemon has ended."""
        if self.started is None or 0.0 <= utc_s - self.started.since_utc_s < SETTLED_S:
            return self, ()
        return self._to(self.started)

    def _to(self, stay: Stay) -> tuple["OutputTrack", tuple[Stay, ...]]:
        before = self.now
        if before is not None and before.state == stay.state:
            return replace(self, started=None), ()
        ended = () if before is None else (before,)
        if stay.state != OutputState.FAULT:
            return OutputTrack(now=stay), ended
        faults = self.faults or (stay.reason,)
        stay = replace(stay, reason="; ".join(faults), reasons=len(faults))
        return OutputTrack(now=stay, faults=faults), ended


def _stay(state: str, utc_s: float, reason: str) -> Stay:
    return Stay(state=state, since_utc_s=utc_s, reason=reason)


@dataclass(frozen=True, slots=True, kw_only=True)
class Watched:
    """What the sink knows, as its file holds it."""

    generation: str = ""
    """Of the store; '' before the first look."""
    row: int = 0
    """Events up to this number were read."""
    track: OutputTrack = field(default_factory=OutputTrack)
    since_utc_s: tuple[tuple[str, str, float], ...] = ()
    """Kind and subject of what has been wrong since a time."""
    ledger: Ledger = field(default_factory=Ledger)
    worn: tuple[Condition, ...] = ()
    """Models that wear out, as of `worn_utc_s`."""
    worn_utc_s: float | None = None


FILE = TypeAdapter(Watched)


def watched(path: Path) -> Watched:
    """Return what a file says; what a new sink knows where there is none that can be read."""
    try:
        return FILE.validate_json(read_whole(path))
    except (OSError, ValueError):
        return Watched()


class AlarmSink:
    """Tells people by one messenger."""

    def __init__(
        self,
        config: SinkConfig,
        configuration: Configuration,
        messenger: Messenger,
        now_utc_s: Callable[[], float] = time.time,
    ) -> None:
        assert config.alarms is not None
        self._alarms: AlarmsConfig = config.alarms
        self._name, self._configuration = config.name, configuration
        self._messenger, self._now_utc_s = messenger, now_utc_s
        self._path = cursor_path(configuration.history.path, config.name).with_suffix(".alarms")
        self._known = self._written = watched(self._path)
        self._looked_s = self._computer_s = float("-inf")
        self._computer: tuple[Condition, ...] | None = None
        self._computer_look: Future[tuple[Condition, ...]] | None = None
        """The one that has not answered yet."""
        self._unwritten = ""
        """Why the file does not hold what is known, '' where it does."""
        self._untold = ""
        """Whom the last message did not reach, or why nobody knows whether it did; '' when it reached all."""

    def open(self, cursor: Cursor) -> Mapping[str, Position]:
        return {EVENTS.name: Position(row=self._known.row)}

    def close(self) -> None:
        """Nothing stays open between two messages."""

    def needs_rows(self) -> bool:
        return True

    def transfer(self, outbox: Outbox, progress: Progress) -> bool:
        """Read what happened, look, and tell what is due."""
        if self._known.generation != progress.cursor.generation:
            self._begin(outbox, progress.cursor.generation)
        events = self._read(outbox)
        if events or not 0.0 <= time.monotonic() - self._looked_s < LOOK_S:
            self._look()
            self._looked_s = time.monotonic()
        self._save()
        told = self._tell()
        if self._unwritten:
            raise SinkWaitsError(self._unwritten)
        if told:
            progress.acknowledged(EVENTS.name, Position(row=self._known.row), self._now_utc_s(), sent=1, stored=1)
        if self._untold:
            raise SinkWaitsError(self._untold)
        return False

    def look_on(self) -> None:
        """Look and tell without the events, while the store cannot be read; raises SinkError."""
        if time.monotonic() - self._looked_s >= LOOK_S:
            self._look()
            self._looked_s = time.monotonic()
        self._save()
        self._tell()

    def _begin(self, outbox: Outbox, generation: str) -> None:
        """Learn from the latest events where the output is; what is over is not told."""
        last = outbox.last_row(EVENTS)
        self._known = replace(self._known, generation=generation, row=max(0, last - EARLIER_ROWS), track=OutputTrack())
        ledger = self._known.ledger
        self._read(outbox)
        self._known = replace(self._known, ledger=ledger)

    def _read(self, outbox: Outbox) -> int:
        """Take the events that are new; return their number."""
        count = 0
        while (batch := outbox.batch(EVENTS, Position(row=self._known.row))) is not None:
            track, ledger = self._known.track, self._known.ledger
            for utc_ms, _, kind, text, *_ in batch.rows:
                track, ended = track.after(utc_ms / 1e3, kind, text)
                for stay in ended:
                    ledger = self._over(ledger, stay, utc_ms / 1e3)
            self._known = replace(self._known, row=batch.after.row, track=track, ledger=ledger)
            count += len(batch.rows)
        return count

    def _over(self, ledger: Ledger, stay: Stay, ended_utc_s: float) -> Ledger:
        condition = self._of_output(stay, ended_utc_s)
        return ledger if condition is None else ledger.over(condition, ended_utc_s)

    def _of_output(self, stay: Stay, now_utc_s: float) -> Condition | None:
        long_enough = now_utc_s - stay.since_utc_s >= self._alarms.hold_longer_than_s
        kind = stay.state.lower()
        if stay.state not in ALARMING or (stay.state == OutputState.HOLD and not long_enough) or not self._told(kind):
            return None
        return Condition(kind=kind, subject="", text=stay.reason, since_utc_s=stay.since_utc_s, reasons=stay.reasons)

    def _told(self, kind: str) -> bool:
        return self._alarms.kinds is None or kind in self._alarms.kinds

    def _look(self) -> None:
        """Ask the daemon, look at the computer, and note what is wrong."""
        now_utc_s = self._now_utc_s()
        self._judge_models(now_utc_s)
        known = self._known
        lasting = Lasting({(kind, subject): since for kind, subject, since in known.since_utc_s}, now_utc_s)
        status = asked(self._configuration.service.socket)
        judged = {"daemon"}
        if isinstance(status, str):
            found = list(lasting.condition("daemon", "", status, self._alarms.daemon_longer_than_s))
            lasting.keep(("fault", *OF_STATUS))
            machine_utc_s = now_utc_s
        else:
            found = list(of_status(status, self._configuration, self._alarms, f"sink {self._name}", lasting))
            found += self._unrecorded(status["output"], lasting)
            judged |= {"fault", "hold", *OF_STATUS}
            machine_utc_s = float(status["time_utc_s"])
        track, ended = known.track.settled(machine_utc_s)
        ledger = known.ledger
        for stay in ended:
            ledger = self._over(ledger, stay, machine_utc_s)
        if track.now is not None and (of_output := self._of_output(track.now, machine_utc_s)) is not None:
            found.append(of_output)
        found += known.worn
        if (computer := self._of_computer(ledger, now_utc_s)) is not None:
            found += computer
            judged |= {"disk", "certificate"}
        wrong = [each for each in found if self._told(each.kind)]
        ledger = ledger.seen(wrong, judged, now_utc_s, unjudged=lasting.one_of_many)
        since = tuple((*key, since) for key, since in lasting.since_utc_s.items())
        self._known = replace(known, track=track, ledger=ledger, since_utc_s=since)

    def _unrecorded(self, output: Mapping[str, Any], lasting: Lasting) -> Iterator[Condition]:
        """Yield a FAULT of which the events do not tell, because the store cannot be written."""
        now = self._known.track.now
        if output["state"] == OutputState.FAULT and (now is None or now.state != OutputState.FAULT):
            yield from lasting.condition("fault", "", output["reason"], SETTLED_S)

    def _of_computer(self, ledger: Ledger, now_utc_s: float) -> tuple[Condition, ...] | None:
        """Return what the latest look at disks and certificates that was answered found; None without one."""
        wait_s = 0.0
        if self._computer_look is None and time.monotonic() - self._computer_s >= COMPUTER_S:
            active = [alarm.key for alarm in ledger.alarms if alarm.ended_utc_s is None]
            self._computer_look, self._computer_s, wait_s = Future(), time.monotonic(), SHARE_WITHIN_S
            look = partial(of_computer, self._configuration, self._alarms, active, now_utc_s)
            threading.Thread(target=_answer, args=(self._computer_look, look), name="computer", daemon=True).start()
        if (answered := self._computer_look) is not None:
            try:
                self._computer = answered.result(wait_s)
            except TimeoutError:
                pass
            finally:
                self._computer_look = None if answered.done() else answered
        return self._computer

    def _judge_models(self, now_utc_s: float) -> None:
        """See once a day whether a model wears out; kept over restarts, as a year of probe values takes its time."""
        before_utc_s = self._known.worn_utc_s
        if before_utc_s is not None and 0.0 <= now_utc_s - before_utc_s < MODELS_S:
            return
        worn: tuple[Condition, ...] = self._known.worn
        try:
            worn = tuple(worn_models(self._configuration, now_utc_s))
        except (HistoryError, RefusedInputError, OSError, sqlite3.Error) as error:
            log.warning("alarms.models_unread", sink=self._name, problem=str(error))
        self._known = replace(self._known, worn=worn, worn_utc_s=now_utc_s)

    def _tell(self) -> bool:
        """Send what is due; return whether people were told."""
        now_utc_s, ledger = self._now_utc_s(), self._known.ledger
        limits = Limits(interval_s=self._alarms.interval_s, remind_s=3600.0 * self._alarms.remind_after_h)
        if not (entries := ledger.due(limits, now_utc_s)):
            return False
        message = Message(machine=self._configuration.machine, time_utc_s=now_utc_s, entries=entries)
        try:
            self._untold, told = self._messenger.send(message), True
            ledger = ledger.told(entries, now_utc_s)
        except UnansweredError as error:
            self._untold, told = str(error), False
            ledger = ledger.sent(entries, now_utc_s)
        self._known = replace(self._known, ledger=ledger)
        self._save()
        return told

    def _save(self) -> None:
        """Replace the file in one step, when it changes."""
        self._unwritten = ""
        if self._known == self._written:
            return
        temporary = self._path.with_name(f".{self._path.name}.{os.getpid()}.tmp")
        try:
            self._path.parent.mkdir(exist_ok=True)
            temporary.write_bytes(FILE.dump_json(self._known))
            temporary.replace(self._path)
        except OSError as error:
            self._unwritten = f"sink {self._name}: {self._path} cannot be written ({error.strerror})"
            return
        finally:
            with suppress(OSError):
                temporary.unlink(missing_ok=True)
        self._written = self._known


def _answer(look: "Future[tuple[Condition, ...]]", found: Callable[[], Iterator[Condition]]) -> None:
    try:
        look.set_result(tuple(found()))
    except Exception as error:
        look.set_exception(error)
