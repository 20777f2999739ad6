"""What is wrong, what people were told of it, and what they are told next: once, bounded in number, with the end of it.

Everything that is due goes together into one message, so that a hundred alarms are one message. Between two messages
lies a least time; FAULT and a daemon that does not run wait for each other only. What begins and ends again before
people could be told counts as one alarm with the number of its times.
"""

from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, replace

from models.json_values import printable

URGENT = ("fault", "daemon")
"""Kinds that do not wait for others."""
LATER = {"ended": 1, "reminder": 2}
"""What stands after that which is new."""
MOST_ENTRIES = 50
"""A message holds at most so many; the others come in the next."""
LONGEST_TEXT = 500
Key = tuple[str, str]


@dataclass(frozen=True, slots=True, kw_only=True)
class Condition:
    """Something that is wrong now."""

    kind: str
    subject: str
    """What of its kind; '' where there is only one."""
    text: str
    """Why, in words."""
    since_utc_s: float
    reasons: int = 1
    """Their number; one more is told again."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Alarm:
    """Something that is or was wrong, and what people were told of it."""

    kind: str
    subject: str
    text: str
    since_utc_s: float
    reasons: int = 1
    times: int = 1
    """How often it began since people were told last."""
    ended_utc_s: float | None = None
    """None: it is still so."""
    told_utc_s: float | None = None
    """When people were last told; None: not yet."""
    told_reasons: int = 0

    @property
    def key(self) -> Key:
        return self.kind, self.subject


@dataclass(frozen=True, slots=True, kw_only=True)
class Entry:
    """What a message says of one alarm."""

    change: str
    """'raised', 'changed', 'reminder' or 'ended'."""
    alarm: Alarm


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """How often people are told."""

    interval_s: float
    remind_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Ledger:
    """Every alarm by its key, and when people were told last."""

    alarms: tuple[Alarm, ...] = ()
    sent_utc_s: float | None = None
    urgent_utc_s: float | None = None
    """When a message last held something urgent."""

    def seen(
        self,
        conditions: Iterable[Condition],
        judged: Collection[str],
        now_utc_s: float,
        *,
        unjudged: Callable[[Key], bool] = lambda _: False,
    ) -> "Ledger":
        """Return the ledger after a look; what is no longer wrong ends, as far as its kind, and itself, was judged."""
        known = {alarm.key: alarm for alarm in self.alarms}
        there = set()
        for condition in map(_on_one_line, conditions):
            key = (condition.kind, condition.subject)
            there.add(key)
            known[key] = _still(known.get(key), condition)
        for key, alarm in known.items():
            over = key not in there and alarm.kind in judged and not unjudged(key)
            if over and alarm.ended_utc_s is None:
                known[key] = replace(alarm, ended_utc_s=max(now_utc_s, alarm.since_utc_s))
        return replace(self, alarms=tuple(known.values()))

    def over(self, condition: Condition, ended_utc_s: float) -> "Ledger":
        """Return the ledger after something that is over already."""
        known = {alarm.key: alarm for alarm in self.alarms}
        condition = _on_one_line(condition)
        alarm = _still(known.get((condition.kind, condition.subject)), condition)
        known[alarm.key] = replace(alarm, ended_utc_s=max(ended_utc_s, alarm.since_utc_s))
        return replace(self, alarms=tuple(known.values()))

    def due(self, limits: Limits, now_utc_s: float) -> tuple[Entry, ...]:
        """Return what is to be told now, the most urgent first; nothing while it is too early."""
        entries = [
            Entry(change=change, alarm=each) for each in self.alarms if (change := _change(each, limits, now_utc_s))
        ]
        urgent = any(entry.alarm.kind in URGENT for entry in entries)
        last_utc_s = self.urgent_utc_s if urgent else self.sent_utc_s
        if not entries or (last_utc_s is not None and 0.0 <= now_utc_s - last_utc_s < limits.interval_s):
            return ()
        entries.sort(key=lambda entry: (entry.alarm.kind not in URGENT, LATER.get(entry.change, 0)))
        return tuple(entries[:MOST_ENTRIES])

    def told(self, entries: Collection[Entry], now_utc_s: float) -> "Ledger":
        """Return the ledger after people were told; what has ended is forgotten."""
        told = {entry.alarm.key: entry.alarm for entry in entries}
        left = []
        for alarm in self.alarms:
            if alarm.key not in told:
                left.append(alarm)
            elif alarm.ended_utc_s is None:
                left.append(replace(alarm, told_utc_s=now_utc_s, told_reasons=alarm.reasons, times=1))
        return replace(self.sent(entries, now_utc_s), alarms=tuple(left))

    def sent(self, entries: Collection[Entry], now_utc_s: float) -> "Ledger":
        """Return the ledger after a message that people may have got: the next one has to wait."""
        urgent = any(entry.alarm.kind in URGENT for entry in entries)
        return replace(self, sent_utc_s=now_utc_s, urgent_utc_s=now_utc_s if urgent else self.urgent_utc_s)


def _on_one_line(condition: Condition) -> Condition:
    """Return it with texts of bounded length in which no character acts on a terminal, a header or a mail."""
    subject, text = (printable(" ".join(each.split()))[:LONGEST_TEXT] for each in (condition.subject, condition.text))
    return replace(condition, subject=subject, text=text)


def _still(known: Alarm | None, condition: Condition) -> Alarm:
    """Return an alarm that is there, or there again before people were told of its end."""
    if known is None:
        return Alarm(**{name: getattr(condition, name) for name in condition.__slots__})
    again = known.ended_utc_s is not None
    return replace(
        known,
        text=condition.text,
        reasons=condition.reasons,
        told_reasons=min(known.told_reasons, condition.reasons) if again else known.told_reasons,
        times=known.times + again,
        ended_utc_s=None,
    )


def _change(alarm: Alarm, limits: Limits, now_utc_s: float) -> str:
    """Return what is to be told of an alarm, '' when nothing."""
    if alarm.ended_utc_s is not None:
        return "ended"
    if alarm.told_utc_s is None:
        return "raised"
    if alarm.reasons > alarm.told_reasons or (alarm.times > 1 and alarm.kind in URGENT):
        return "changed"
    return "reminder" if not 0.0 <= now_utc_s - alarm.told_utc_s < limits.remind_s else ""
