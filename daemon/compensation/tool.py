"""Follows the tool in the spindle: its number, and from when its own expansion counts."""

from daemon.compensation.references import References
from models.control.inhibit import Inhibit, InhibitCode
from models.control.reference_records import ToolOrigin
from models.records import ThermalErrorEstimate


class ToolInSpindle:
    """Restarts the tool term at a tool change and a tool setting; owned by the control task."""

    def __init__(self, references: References) -> None:
        self._references = references
        self._polled: int | None = None
        self._named: tuple[int, int | None] | None = None
        """The program that has named the tool by the handshake, and what a poll showed then."""
        self._counted_from: str | None = None
        self._seen: dict[str, tuple[float, float]] = {}
        """Of each label since this reference when its sensors were last heard [s], and which mean increment [K]."""
        self._shown_s: dict[str, float] = {}
        """When that increment was an estimate's [s]."""
        self.number = 0

    def on_sample(self, seen: int, estimate: ThermalErrorEstimate | None) -> None:
        """Take the tool number of a poll: another one is a tool change, unless the program names its tools itself."""
        self._follow(estimate)
        program_ended = self._named is not None and self._named[0] != self._program
        if self._named is not None and seen == self.number:
            self._named = self._named[0], seen
        if self._polled is None:
            self._polled = self.number = seen
        elif seen != self._polled or program_ended:
            changed = seen != (self._named[1] if self._named is not None else self._polled)
            self._polled = seen
            self._named = None if program_ended else self._named
            if self._named is None and changed:
                self.begin(seen, estimate)

    def name(self, number: int, estimate: ThermalErrorEstimate | None) -> None:
        """Take the NC program's word for the tool in the spindle: it counts until another program runs."""
        self._named = self._program, self._polled
        self.begin(number, estimate)

    @property
    def _program(self) -> int:
        return 0 if self._references.sample is None else self._references.sample.program

    def inhibit(self) -> Inhibit | None:
        """Return why it is not known which tool is in the spindle: a control may show the one that is prepared."""
        named = self._named
        if named is None or self._polled in (named[1], self.number) or not self._references.tools_differ:
            return None
        return Inhibit(
            code=InhibitCode.REFERENCE,
            text=f"the control shows T{self._polled}, and the NC program has named T{self.number}",
            remedy="let the program name each tool as it comes into the spindle, and read the tool in the spindle, not "
            "the one that is prepared (cnc.focas.tool_macro)",
        )

    def begin(self, number: int, estimate: ThermalErrorEstimate | None) -> None:
        """Let the tool term of this tool count from now."""
        self.number = number
        self._follow(estimate)
        begin_degc = {label: increment for label, (_, increment) in self._seen.items()}
        counted_from = estimate.reference_id if estimate is not None else None
        self._references.tool_begins(ToolOrigin(number=number, begin_degc=begin_degc), counted_from, self._shown_s)

    def _follow(self, estimate: ThermalErrorEstimate | None) -> None:
        if estimate is None:
            return
        if estimate.reference_id != self._counted_from:
            self._counted_from, self._seen, self._shown_s = estimate.reference_id, {}, {}
        at_s, increments = estimate.trace.first_byte.monotonic_s, estimate.label_increment_degc
        if estimate.held_s == 0.0:
            self._references.tool_set_right(self._seen, increments, at_s)
        self._seen |= {label: (at_s - estimate.held_s, increment) for label, increment in increments.items()}
        self._shown_s |= dict.fromkeys(increments, at_s)

    @property
    def seen_s(self) -> dict[str, float]:
        """When the sensors of each label were last heard [s]."""
        return {label: at_s for label, (at_s, _) in self._seen.items()}
