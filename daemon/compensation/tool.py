"""Follows the tool in the spindle: its number, and from when its own expansion counts."""

import math
from collections.abc import Mapping
from types import MappingProxyType

from daemon.compensation.references import References
from models.control.reference import TOOL_UNKNOWN_S
from models.control.reference_records import ToolOrigin, ToolSeen
from models.control.state import Inhibit, InhibitCode
from models.records import ThermalErrorEstimate

NOTHING: Mapping[str, float] = MappingProxyType({})


class ToolInSpindle:
    """Restarts the tool term at a tool change and a tool setting; owned by the control task."""

    def __init__(self, references: References) -> None:
        self._references = references
        self._polled: int | None = None
        self._named: tuple[int, int | None] | None = None
        """The program that has named the tool by the handshake, and what a poll showed then."""
        self._shown: tuple[int, ...] = ()
        """Other tools that polls have shown since then."""
        self._counted_from: str | None = None
        self._seen: dict[str, tuple[float, float]] = {}
        """Of each label since this reference when its sensors were last heard [s], and which mean increment [K]."""
        self._shown_s: dict[str, float] = {}
        """When that increment was an estimate's [s]."""
        self._gap_s = 0.0
        self._count: float | None = None
        self.number = 0

    def on_sample(
        self, shown: int, estimate: ThermalErrorEstimate | None, gap_s: float = 0.0, count: float | None = None
    ) -> None:
        """Take the tool number of a poll: another one is a tool change, unless the program names its tools itself.

        `gap_s`: since the poll before, over a restart too [s]. `count`: how many have come, where the NC counts them.
        """
        self._follow(estimate)
        self._gap_s = max(self._gap_s, gap_s)
        if self._polled is None:
            self._begin_with(shown)
        if self._references.left is not None:  # nothing counts from what the previous run left yet
            return
        gap_s, self._gap_s = self._gap_s, 0.0
        more = 0.0 if count is None or self._count is None else count - self._count
        known = gap_s <= TOOL_UNKNOWN_S and (more == 0.0 or more in range(1, int(gap_s) + 2))  # one a second at most
        came, self._count = more != 0.0, self._count if count is None else count
        program_ended = self._named is not None and self._named[0] != self._program
        if self._named is not None and shown == self.number and not self._others:
            self._named, self._shown = (self._named[0], shown), ()
        elif self._named is not None and shown not in self._shown:
            self._shown = (*self._shown, shown)
        if shown != self._polled or program_ended or came:
            changed = came or shown != (self._named[1] if self._named is not None else self._polled)
            self._polled = shown
            self._named = None if program_ended else self._named
            if came or (self._named is None and changed):
                self.begin(self.number if self._named else shown, estimate, known=known)
        self._keep()

    def _begin_with(self, shown: int) -> None:
        """Begin with the tool that the previous run knew in the spindle, or with the one that the control shows."""
        left = self._references.left
        kept = None if left is None else left.tool
        if kept is None:
            self._polled = self.number = shown
            return
        self._polled, self.number, self._shown, self._count = kept.shown, kept.number, kept.shown_since, kept.count
        self._named = None if kept.named_by is None else (kept.named_by, kept.shown_when_named)

    def _keep(self) -> None:
        by, then = self._named or (None, None)
        now, since = self.number if self._polled is None else self._polled, self._shown
        self._references.tool_seen = ToolSeen(
            number=self.number, shown=now, named_by=by, shown_when_named=then, shown_since=since, count=self._count
        )

    def name(self, number: int, estimate: ThermalErrorEstimate | None) -> None:
        """Take the NC program's word for the tool in the spindle: it counts until another program runs."""
        self._named, self._shown = (self._program, self._polled), () if self._polled is None else (self._polled,)
        self.begin(number, estimate)
        self._keep()

    @property
    def _program(self) -> int:
        return 0 if self._references.sample is None else self._references.sample.program

    @property
    def _others(self) -> tuple[int, ...]:
        """What polls have shown since the program named its tool that is neither this nor what they showed then."""
        return tuple(shown for shown in self._shown if self._named and shown not in (self._named[1], self.number))

    @property
    def in_question(self) -> tuple[int, ...]:
        """The tools of which one is in the spindle, where it is not known which: a control may have shown the next.

        When it shows the named one again, that one went and came, or is the next.
        """
        named = self._named
        if named is None and self._references.tells_prepared_tool:
            return (self.number, *self._references.memory.tools_set)
        if named is None or self._polled is None or (self._polled in (named[1], self.number) and not self._others):
            return ()
        return (*self._shown, self._polled, self.number)

    def inhibit(self) -> Inhibit | None:
        """Return why it is not known which tool is in the spindle, None where it is, or where it does not matter."""
        return self.unknown() if self._references.tools_differ else None

    def unknown(self) -> Inhibit | None:
        """Return why it is not known which tool is in the spindle, None where it is."""
        if not self.in_question:
            return None
        text = f"the control shows T{self._polled}, and the NC program has named T{self.number}"
        if self._named is None:
            text = f"T{self._polled} is the latest T word, and the NC program has not named the tool in the spindle"
        elif self._polled == self.number:
            text = f"the control has shown T{self._others[-1]} since the NC program named T{self.number}"
        return Inhibit(
            code=InhibitCode.REFERENCE,
            text=text,
            remedy="let the program name each tool as it comes into the spindle, and read the tool in the spindle, not "
            "the one that is prepared (cnc.focas.tool_macro)",
        )

    def begin(
        self,
        number: int,
        estimate: ThermalErrorEstimate | None,
        *,
        known: bool = True,
        before_um: Mapping[str, float] = NOTHING,
    ) -> None:
        """Let the tool term of this tool count from now; `known`: it came within the last minute.

        `before_um`: of axes along which it goes on from so much, since it is set on another one [um].
        """
        self.number = number
        self._follow(estimate)
        if (kept := self._references.kept_id) is not None and kept != self._counted_from:
            self._count_from(kept)  # nothing has been estimated since the reference
        begin_degc = {label: increment if known else math.nan for label, (_, increment) in self._seen.items()}
        origin = ToolOrigin(number=number, begin_degc=begin_degc, before_um=before_um)
        self._references.tool_begins(origin, kept, self._shown_s)

    def _count_from(self, reference_id: str | None) -> None:
        """Begin to follow the labels since a reference: what nobody has heard since had its increment of then."""
        known = reference_id == self._references.kept_id
        self._counted_from, self._shown_s = reference_id, {}
        self._seen = self._references.labels_at_reference if known else {}

    def _follow(self, estimate: ThermalErrorEstimate | None) -> None:
        if estimate is None:
            return
        if estimate.reference_id != self._counted_from:
            self._count_from(estimate.reference_id)
        at_s, increments = estimate.trace.first_byte.monotonic_s, estimate.label_increment_degc
        heard_s = at_s - estimate.held_s
        self._references.tool_set_right(self._seen, increments, heard_s)
        self._seen |= {label: (heard_s, increment) for label, increment in increments.items()}
        self._shown_s |= dict.fromkeys(increments, at_s)

    @property
    def seen_s(self) -> dict[str, float]:
        """When the sensors of each label were last heard [s]."""
        return {label: at_s for label, (at_s, _) in self._seen.items()}
