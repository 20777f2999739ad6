"""Frames of a LATSIS line -> temperature cycles. No I/O; time comes with the bytes.

A cycle is complete as soon as the lowest ID that is waited for has arrived, so that nothing waits. An
incomplete pass is closed by the next pass or by silence. The pass that was under way when the port was
opened is discarded and counted.
"""

from collections import Counter, deque
from collections.abc import Sequence

from config.schema.temperatures import LineConfig, SensorConfig
from drivers.latsis.frames import Frame, FrameError, FrameFault, FrameParser, frame_bytes
from drivers.latsis.line_pass import Arrival, LinePass, Numbering, NumberingWatch
from drivers.latsis.values import ChainDecoder, ChainValues
from models.records import Instant, TemperatureCycle, Trace

SILENCE_PERIODS = 0.25
"""A line that sends nothing for this share of its cycle period has ended its pass."""
LONGEST_PASS_PERIODS = 1.5
"""A pass that is still open after so many cycle periods is closed whatever arrives."""
MIN_SILENCE_REAL_S = 0.05
"""Shorter pauses say nothing, even on a fast simulated clock: this computer may just have been busy."""
SILENT_AFTER_CYCLES = 3
"""A sensor that is missing in so many consecutive undisturbed passes is not waited for any more."""
NAMED_REJECTS = 8
"""How many rejected pieces a cycle's faults quote before they are counted."""


class CycleAssembler:
    """Turns the bytes of one line, with their time of arrival, into temperature cycles."""

    def __init__(self, line: LineConfig, sensors: Sequence[SensorConfig]) -> None:
        self._line = line
        self._chain = ChainDecoder(line, sensors)
        digits = self._chain.value_digits
        self._bytes = {wire_id: frame_bytes(line.frame_grammar, n) for wire_id, n in digits.items()}
        self._parser = FrameParser(line.frame_grammar, digits)
        self._watch = NumberingWatch(line.name, self._chain.lowest, self._chain.highest)
        self._unguarded = line.frame_grammar.checksum == "none"
        self._arrivals: deque[tuple[int, Instant]] = deque()
        self._last_record: Instant | None = None
        self._pass: LinePass | None = None
        self._ended_at: int | None = None
        self._synchronised = False
        self._number = 0
        self.frames = 0
        self._last_end = 0
        self.last_error: FrameError | None = None
        self._missed: Counter[int] = Counter()
        self._await_all_but(frozenset())
        self._forget_pass()

    def _await_all_but(self, silent: frozenset[int]) -> None:
        """Set which IDs are not waited for, and with them the bytes that are awaited below each ID."""
        self._silent = silent
        self._lowest_awaited = min((i for i in self._bytes if i not in silent), default=self._chain.highest)
        self._bytes_below: dict[int, int] = {}
        total = 0
        for wire_id, count in self._bytes.items():
            self._bytes_below[wire_id] = total
            total += 0 if wire_id in silent else count
        self._bytes_per_pass = total

    def _forget_pass(self) -> None:
        self._rejects: list[FrameError] = []
        self._reject_count = 0
        self._rejected_before = 0
        self._announced: int | None = None
        self._displaced_kinds: set[int] = set()
        self._below: set[int] = set()

    @property
    def quiet_since(self) -> Instant | None:
        """When the last frame or rejected piece of the pass under way arrived; None between passes."""
        return None if self._pass is None else self._last_record

    @property
    def earliest_end(self) -> int:
        """Byte of the stream before which the cycle under way, or the next one, cannot be complete."""
        if not self.frames:
            return 0
        if self._pass is None:
            return self._last_end + self._bytes_per_pass
        return self._last_end + self._bytes_below.get(self._pass.lowest, 0)

    def feed(self, data: bytes, arrived: Instant) -> list[TemperatureCycle]:
        """Take bytes that arrived together and return the cycles that they complete or close."""
        cycles = self.poll(arrived)
        self._arrivals.append((self._parser.bytes_fed + len(data), arrived))
        earlier = self._arrivals[-2][0] if len(self._arrivals) > 1 else 0
        for record in self._parser.feed(data):
            self._last_record = arrived
            if isinstance(record, Frame):
                if not (record.offset >= earlier and self._goes_on(record, arrived)):
                    cycles += self._on_frame(record)
            else:
                self._on_error(record)
        while len(self._arrivals) > 1 and self._arrivals[0][0] <= self._parser.bytes_judged:
            self._arrivals.popleft()
        return cycles

    def poll(self, now: Instant) -> list[TemperatureCycle]:
        """Close a pass that silence has ended; to be called a few times per silence."""
        silent = self._last_record is not None and self._longer(self._last_record, now, SILENCE_PERIODS)
        if self._pass is None:
            if silent:
                self._ended_at = None
                self._rejected_before = 0
                self._announced = None
            return []
        if silent or self._longer(self._pass.first_byte, now, LONGEST_PASS_PERIODS):
            return self._close()
        return []

    def finish(self) -> list[TemperatureCycle]:
        """Close the pass under way because the link is gone."""
        return [] if self._pass is None else self._close()

    def _longer(self, since: Instant, now: Instant, periods: float) -> bool:
        limit_s = periods * self._line.cycle_period_s
        return now.monotonic_s - since.monotonic_s > limit_s and now.real_s - since.real_s > MIN_SILENCE_REAL_S

    def _arrival(self, frame: Frame) -> Arrival:
        if len(self._arrivals) == 1 or frame.offset >= self._arrivals[-2][0]:
            instant = self._arrivals[-1][1]
            return Arrival(frame, instant, instant)
        first = next(instant for end, instant in self._arrivals if end > frame.offset)
        last = next(instant for end, instant in self._arrivals if end >= frame.end)
        return Arrival(frame, first, last)

    def _on_error(self, error: FrameError) -> None:
        self.last_error = error
        self._reject_count += 1
        if self._reject_count <= NAMED_REJECTS:
            self._rejects.append(error)
        if error.kind is FrameFault.TOO_WIDE and error.wire_id is not None:
            self._displaced_kinds.add(error.wire_id)
        if self._pass is not None:
            self._pass.rejects_since += 1
        elif self._announced is None:
            self._announced = error.wire_id
            self._rejected_before += error.end - error.offset if error.wire_id is None else 0

    def _goes_on(self, frame: Frame, arrived: Instant) -> bool:
        """Take a frame within a pass that follows its predecessor, as nearly all do; False when it needs a closer look.

        All of it arrived with the latest bytes, and it is not the one that ends the pass.
        """
        if self._pass is None or frame.wire_id <= self._lowest_awaited or frame.wire_id in self._silent:
            return False
        if not self._pass.go_on(frame, arrived):
            return False
        self.frames += 1
        self._last_end = frame.end
        return True

    def _on_frame(self, frame: Frame) -> list[TemperatureCycle]:
        self.frames += 1
        self._last_end = frame.end
        if frame.wire_id in self._silent:
            self._await_all_but(frozenset(i for i in self._silent if i > frame.wire_id))
        cycles: list[TemperatureCycle] = []
        arrival = self._arrival(frame)
        if self._pass is not None:
            successors = self._pass.take(arrival)
            if successors:
                cycles += self._close()
                self._open(successors[0]).take(successors[1])
        elif self._ended_at is not None and frame.wire_id < self._ended_at:
            if frame.wire_id < self._chain.lowest:
                self._below.add(frame.wire_id)
            return []
        else:
            self._open(arrival)
        if self._pass is not None and self._pass.lowest <= self._lowest_awaited and self._at_end(self._pass):
            ended_at = self._pass.lowest
            cycles += self._close()
            self._ended_at = ended_at
        return cycles

    def _open(self, arrival: Arrival) -> LinePass:
        announced = arrival.frame.wire_id if self._announced is None else self._announced
        self._pass = LinePass(arrival, announced=announced, rejected_bytes=self._rejected_before)
        self._ended_at = None
        return self._pass

    def _at_end(self, line_pass: LinePass) -> bool:
        """Whether the lowest ID that is waited for has arrived.

        Without a checksum an ID may be damaged and look like the lowest. So a jump onto it counts as the
        end only if rejected bytes explain the frames that it skips; otherwise the next frame or silence tells.
        """
        if not self._chain.lowest <= line_pass.lowest <= self._lowest_awaited:
            return False
        if not self._unguarded or line_pass.rejects_in_last_step:
            return True
        before = min(line_pass.before, self._chain.highest + 1)
        return all(i in self._silent for i in range(line_pass.lowest + 1, int(before)))

    def _close(self) -> list[TemperatureCycle]:
        line_pass = self._pass
        assert line_pass is not None
        line_pass.finish()
        self._pass = None
        self._ended_at = None
        joined_under_way = not self._synchronised and line_pass.announced != self._chain.highest
        self._synchronised = True
        cycles = [] if joined_under_way else [self._cycle(line_pass)]
        self._forget_pass()
        return cycles

    def _cycle(self, line_pass: LinePass) -> TemperatureCycle:
        numbering = self._numbering(line_pass)
        assigned = self._watch.judge(numbering)
        values = self._chain.decode(line_pass.frames, line_pass.displaced) if assigned else self._chain.withheld()
        unexpected = numbering.below or numbering.displaced_kinds or not assigned
        faults = [self._watch.alarm or self._watch.describe(numbering)] if unexpected else []
        faults += self._faults(line_pass, values)
        complete = assigned and (values.missing | values.duplicate) <= self._silent
        if assigned:
            self._count_missing(line_pass, values)
        self._number += 1
        return TemperatureCycle(
            line=self._line.name,
            number=self._number,
            degc=values.degc,
            quality=values.quality,
            reason=values.reason,
            complete=complete,
            faults=tuple(faults),
            trace=Trace(first_byte=line_pass.first_byte, last_byte=line_pass.last_byte),
        )

    def _numbering(self, line_pass: LinePass) -> Numbering:
        rejected = line_pass.rejected_bytes
        above = sum(n for wire_id, n in self._bytes.items() if wire_id > line_pass.announced) if rejected else 0
        lowest = self._chain.lowest
        below = {i for i in line_pass.frames if i < lowest} if line_pass.lowest < lowest else set()
        return Numbering(
            announced=line_pass.announced,
            explained=0 < above <= 2 * rejected,
            below=frozenset(self._below | below),
            displaced_kinds=frozenset(self._displaced_kinds),
        )

    def _count_missing(self, line_pass: LinePass, values: ChainValues) -> None:
        """Count which sensors are missing; a disturbed pass does not count."""
        for wire_id in self._missed.keys() - values.missing:
            del self._missed[wire_id]
        if self._reject_count or line_pass.displaced:
            return
        self._missed.update(values.missing)
        silent = frozenset(i for i, cycles in self._missed.items() if cycles >= SILENT_AFTER_CYCLES)
        if silent != self._silent:
            self._await_all_but(silent)

    def _faults(self, line_pass: LinePass, values: ChainValues) -> list[str]:
        faults = list(values.faults)
        for wire_id, offsets in sorted(line_pass.displaced.items(), reverse=True):
            at = " and ".join(str(offset) for offset in offsets)
            faults.append(f"{self._chain.name(wire_id)} came out of order at byte {at}: its values are dropped")
        if lost := values.missing - self._silent:
            faults.append(f"not received: {self._chain.names(lost)}")
        if silent := values.missing & self._silent:
            faults.append(f"missing and no longer waited for: {self._chain.names(silent)}")
        faults += [str(error) for error in self._rejects]
        if self._reject_count > NAMED_REJECTS:
            faults.append(f"{self._reject_count - NAMED_REJECTS} more pieces rejected")
        return [fault if fault.startswith("line ") else f"line {self._line.name}: {fault}" for fault in faults]
