"""What people get of alarms: one message, as JSON for programs and as text for people."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, Protocol

from daemon.sinks.alarms.ledger import Entry
from daemon.sinks.contract import SinkError
from models.json_values import printable

LONGEST_SUBJECT = 150
NAMES = {
    "fault": "FAULT",
    "daemon": "the daemon does not run",
    "hold": "HOLD",
    "output": "output",
    "link": "link",
    "sensor": "sensor",
    "model": "model",
    "store": "history store",
    "job": "job",
    "disk": "disk",
    "certificate": "certificate",
}
"""Kind -> what people call it."""
WITHOUT_SUBJECT = {"sensor": "many sensors"}
"""The same of kinds that have a subject as a rule."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Message:
    """What is told of one machine at one time; without entries it is a test."""

    machine: str
    time_utc_s: float
    entries: Sequence[Entry] = ()

    @property
    def number(self) -> str:
        content = [self.machine, *(_number(self.machine, entry) for entry in self.entries)]
        return _hash(content if self.entries else [*content, self.time_utc_s])

    @property
    def subject(self) -> str:
        """One line for people."""
        if not self.entries:
            return _line(f"{self.machine}: test of the alarms")
        first, more = in_words(self.entries[0]), len(self.entries) - 1
        return _line(f"{self.machine}: {first}" if not more else f"{self.machine}: first of {more + 1}: {first}")

    @property
    def text(self) -> str:
        """Several lines for people."""
        lines = [f"Machine: {_line(self.machine)}", f"Time: {_local(self.time_utc_s)}", ""]
        lines += [f"- {in_words(entry)}" for entry in self.entries]
        if not self.entries:
            lines.append("This is a test: alarms of this machine arrive here. Nothing is wrong.")
        return "\n".join(lines) + "\n"

    def document(self) -> dict[str, Any]:
        return {
            "id": self.number,
            "machine": printable(self.machine),
            "time_utc": _iso(self.time_utc_s),
            "test": not self.entries,
            "text": self.subject,
            "alarms": [_entry(self.machine, entry) for entry in self.entries],
        }


class UnansweredError(SinkError):
    """All of a message was handed over, and nothing says whether it was taken: people may have got it."""


class Messenger(Protocol):
    """Brings messages to people."""

    def send(self, message: Message) -> str:
        """Bring a message; raises SinkError when nobody gets it, and returns who does not, '' when all do."""


def in_words(entry: Entry) -> str:
    alarm = entry.alarm
    alone = WITHOUT_SUBJECT.get(alarm.kind, NAMES[alarm.kind])
    what = f"{NAMES[alarm.kind]} {alarm.subject}" if alarm.subject else alone
    times = f" ({alarm.times} times)" if alarm.times > 1 else ""
    if entry.change == "ended":
        assert alarm.ended_utc_s is not None
        return f"over after {duration(alarm.ended_utc_s - alarm.since_utc_s)}: {what}{times}: {alarm.text}"
    still = {"reminder": " still", "changed": " again or for one more reason"}.get(entry.change, "")
    return f"{what}{still}{times}, since {_local(alarm.since_utc_s)}: {alarm.text}"


def duration(seconds: float) -> str:
    """Return a time as people say it."""
    for unit, size_s in (("d", 86_400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= 2.0 * size_s:
            return f"{seconds / size_s:.0f} {unit}"
    return f"{seconds:.0f} s"


def _entry(machine: str, entry: Entry) -> dict[str, Any]:
    alarm, ended_utc_s = entry.alarm, entry.alarm.ended_utc_s
    return {
        "id": _number(machine, entry),
        "change": entry.change,
        "kind": alarm.kind,
        "subject": alarm.subject,
        "text": alarm.text,
        "sentence": in_words(entry),
        "since_utc": _iso(alarm.since_utc_s),
        "ended_utc": None if ended_utc_s is None else _iso(ended_utc_s),
        "duration_s": None if ended_utc_s is None else round(ended_utc_s - alarm.since_utc_s, 1),
        "times": alarm.times,
    }


def _number(machine: str, entry: Entry) -> str:
    alarm = entry.alarm
    told = alarm.told_utc_s if entry.change == "reminder" else None
    return _hash([machine, entry.change, *alarm.key, alarm.since_utc_s, alarm.reasons, alarm.times, told])


def _hash(content: Sequence[object]) -> str:
    return hashlib.sha256(json.dumps(content).encode()).hexdigest()[:24]


def _iso(utc_s: float) -> str:
    return datetime.fromtimestamp(utc_s, UTC).isoformat(timespec="seconds")


def _local(utc_s: float) -> str:
    """Return a time as the clocks of the computer's place show it, with what it is ahead of UTC."""
    return datetime.fromtimestamp(utc_s, UTC).astimezone().isoformat(sep=" ", timespec="seconds")


def _line(text: str) -> str:
    line = printable(" ".join(text.split()))
    return line if len(line) <= LONGEST_SUBJECT else f"{line[: LONGEST_SUBJECT - 1]}…"
