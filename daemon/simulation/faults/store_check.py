"""What the store of a fault campaign holds, against what was acknowledged and what the CNC received."""

import contextlib
from array import array
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from daemon.history.columns.kinds import WRITES
from daemon.history.database import HistoryError
from daemon.history.reader import HistoryReader
from daemon.simulation.faults.invariants import Ledger
from daemon.simulation.faults.operations_check import Probe
from daemon.simulation.faults.process import NUMBER_BITS, Acknowledgements, cycle_key
from daemon.simulation.faults.state_oracle import STARTS, unlawful
from models.records import WriteOutcome

EVER = (0.0, 1e11)
AT_ONCE_S = 86400.0


class StoreCheck:
    """Looks for what must be there; counts what is lost."""

    def __init__(self, path: Path, lines: dict[str, int], ledger: Ledger) -> None:
        """Prepare; `lines` gives one sensor of each line."""
        self._path = path
        self._lines = lines
        self._ledger = ledger
        self._checked: dict[str, int] = {}
        self._moved: list[Path] = []
        """Where stores stand that somebody has moved away while they were written."""
        self.lost = 0

    def move_away(self) -> None:
        """Move the store away, as a person might who wants its space."""
        if self._path.exists():
            self._moved.append(self._path.rename(self._path.with_name(f"moved-{len(self._moved)}.sqlite")))

    def _readers(self) -> Iterator[HistoryReader]:
        for path in (*self._moved, self._path):
            with contextlib.suppress(HistoryError), HistoryReader(path) as reader:
                yield reader

    def acknowledged_cycles(self, acknowledgements: Acknowledgements, *, all_of_them: bool = False) -> None:
        """Look for every cycle acknowledged since the last call (or ever)."""
        for line, keys in acknowledgements.keys.items():
            first = 0 if all_of_them else self._checked.get(line, 0)
            wanted = np.frombuffer(array("q", keys[first:]), dtype=np.int64)
            self._checked[line] = len(keys)
            if not wanted.size:
                continue
            missing = int((~np.isin(wanted, self._stored(line, wanted))).sum())
            self.lost += missing
            count = self._ledger.counts["acknowledged_cycles_kept"]
            count.checked += int(wanted.size)
            count.violated += missing
            if missing:
                count.examples.append(f"line {line}: {missing} of {wanted.size} acknowledged cycles are not stored")

    def _stored(self, line: str, wanted: "np.typing.NDArray[np.int64]") -> "np.typing.NDArray[np.int64]":
        times_s = (wanted >> NUMBER_BITS) / 1e3
        found: list[int] = []
        for reader in self._readers():
            from_s = float(times_s.min())
            while from_s <= float(times_s.max()):
                to_s = from_s + AT_ONCE_S
                history = reader.temperatures([self._lines[line]], from_s, to_s)
                for name, number, time_s in zip(history.line, history.number, history.time_s, strict=True):
                    if name == line:
                        found.append(cycle_key(int(number), round(float(time_s) * 1e3)))
                from_s = to_s
        return np.array(found, dtype=np.int64)

    def audit(self, open_ones: int, blocks: list[float] | None, *, written: bool = True) -> None:
        """Check that every intent has an outcome but `open_ones`, and that every block has its intent.

        A kill may leave one open, which the next life settles. `blocks` are the sequence numbers that the CNC
        received in a life that ended in order. Before anything was `written` there need not be a store: the daemon
        may have been killed while it made one.
        """
        audited: set[float] = set()
        try:
            with HistoryReader(self._path) as reader:
                unsettled = reader.unsettled_writes()
        except HistoryError as error:
            self._ledger.check("audit_complete", not written, str(error))
            return
        why = f"{len(unsettled)} intents have no outcome, {open_ones} may be open"
        self._ledger.check("audit_complete", len(unsettled) <= open_ones, why)
        if not blocks:
            return
        for reader in self._readers():
            frame = reader.frame(WRITES, *EVER, ["outcome", "sequence"])
            audited |= set(frame.numbers("sequence")[frame.integers("outcome") != int(WriteOutcome.INTENDED)].tolist())
        for sequence in blocks:
            self._ledger.check(
                "audit_has_every_block", sequence in audited, f"block {sequence:g} reached the CNC and is not audited"
            )

    def probes(self, expected: Sequence[Probe], axes: Sequence[str]) -> None:
        """Check that every probe value that the daemon has taken is in the store, once."""
        stored: Counter[tuple[str, float]] = Counter()
        for reader in self._readers():
            stored.update((p.axis, round(p.deviation_um, 3)) for p in reader.probes(*EVER) if p.accepted)
        wanted = Counter((axes[probe.axis - 1], round(probe.deviation_um, 3)) for probe in expected)
        for probe, count in wanted.items():
            self._ledger.check("probes_kept", stored[probe] >= count, f"{probe} is stored {stored[probe]} times")

    def changes_of_state(self) -> None:
        """Check that every change of state that the daemon has recorded is one that the specification knows."""
        try:
            with HistoryReader(self._path) as reader:
                events = [event for event in reader.events(*EVER) if event.kind in ("state", "start")]
        except HistoryError as error:
            self._ledger.check("changes_of_state_known", False, str(error))
            return
        for event in events:
            change, _, reason = event.text.partition(": ")
            if event.kind == "start":
                right = change in STARTS
            else:
                before, _, after = change.partition(" -> ")
                right = not unlawful([(before, after)])
            self._ledger.check("changes_of_state_known", right, f"{event.time_s:.1f}: {change} ({reason})")

    def displacements(self) -> None:
        """Check that no row of the logger's file was stored twice, whatever became of the file."""
        try:
            with HistoryReader(self._path) as reader:
                times_s = reader.displacements(*EVER).time_s
        except HistoryError as error:
            self._ledger.check("displacements_once", False, str(error))
            return
        twice = int(times_s.size - np.unique(times_s).size)
        count = self._ledger.counts["displacements_once"]
        count.checked += int(times_s.size)
        count.violated += twice
        if twice:
            count.examples.append(f"{twice} of {times_s.size} rows of the displacement file are stored twice")
