"""What a fault campaign demands of the store, and that it finds what is missing there."""

from array import array
from pathlib import Path

import numpy as np
import pytest
from history_records import EPOCH_S, SMALL, StillClock, command, cycle, displacement, macros, receipt

from daemon.history.rows import utc_ms
from daemon.history.writer import HistoryWriter
from daemon.simulation.faults.invariants import Ledger
from daemon.simulation.faults.operations_check import Probe
from daemon.simulation.faults.process import Acknowledgements, cycle_key
from daemon.simulation.faults.store_check import StoreCheck
from models.records import ProbeSample

NAMES = ("acknowledged_cycles_kept", "audit_complete", "audit_has_every_block", "displacements_once")
SENSORS = {"spindle": 13, "bed": 21}
STILL_UM = np.zeros(3)


@pytest.fixture
def stored(tmp_path: Path) -> tuple[Path, Acknowledgements]:
    """A store with ten cycles of a line, all acknowledged, and one settled write with sequence number 7."""
    path = tmp_path / "history.sqlite"
    writer = HistoryWriter(path, clock=StillClock(), machine=SMALL)
    writer.start()
    acknowledgements = Acknowledgements()
    for number in range(1, 11):
        record = cycle("bed", number, EPOCH_S + 10.0 * number, np.array([20.0, 21.0]))
        writer.temperatures(None, record)
        keys = acknowledgements.keys.setdefault("bed", array("q"))
        keys.append(cycle_key(number, utc_ms(record.trace.first_byte)))
    written = macros(7, STILL_UM)
    intent = writer.write_intent(command(STILL_UM), written, "estimate")
    writer.write_outcome(intent, receipt(EPOCH_S, written, sequence=7))
    writer.close()
    return path, acknowledgements


def checked(path: Path) -> tuple[StoreCheck, Ledger]:
    ledger = Ledger(NAMES)
    return StoreCheck(path, SENSORS, ledger), ledger


def test_what_was_acknowledged_is_found(stored: tuple[Path, Acknowledgements]) -> None:
    path, acknowledgements = stored
    check, ledger = checked(path)
    check.acknowledged_cycles(acknowledgements)
    check.audit(0, [7.0])
    assert (ledger.counts["acknowledged_cycles_kept"].checked, check.lost, ledger.violations) == (10, 0, 0)
    check.acknowledged_cycles(acknowledgements)
    assert ledger.counts["acknowledged_cycles_kept"].checked == 10, "only what is new is looked for again"
    check.acknowledged_cycles(acknowledgements, all_of_them=True)
    assert ledger.counts["acknowledged_cycles_kept"].checked == 20


def test_a_cycle_that_is_not_there_is_lost(stored: tuple[Path, Acknowledgements]) -> None:
    path, acknowledgements = stored
    acknowledgements.keys["bed"].append(cycle_key(11, round((EPOCH_S + 110.0) * 1e3)))
    check, ledger = checked(path)
    check.acknowledged_cycles(acknowledgements)
    assert (check.lost, ledger.counts["acknowledged_cycles_kept"].violated) == (1, 1)


def test_a_block_without_an_intent_is_found(stored: tuple[Path, Acknowledgements]) -> None:
    check, ledger = checked(stored[0])
    check.audit(0, [7.0, 8.0])
    assert ledger.counts["audit_has_every_block"].violated == 1


def test_more_open_intents_than_kills_are_found(tmp_path: Path) -> None:
    path = tmp_path / "history.sqlite"
    writer = HistoryWriter(path, clock=StillClock(), machine=SMALL)
    writer.start()
    for sequence in (1, 2):
        writer.write_intent(command(STILL_UM), macros(sequence, STILL_UM), "estimate")
    writer.close()
    check, ledger = checked(path)
    check.audit(2, None)
    assert ledger.violations == 0
    check.audit(1, None)
    assert ledger.counts["audit_complete"].violated == 1


def test_a_row_that_is_stored_twice_is_found(tmp_path: Path) -> None:
    path = tmp_path / "history.sqlite"
    writer = HistoryWriter(path, clock=StillClock(), machine=SMALL)
    writer.start()
    for minute in (1, 2, 2, 3):
        writer.displacement(displacement(EPOCH_S + 60.0 * minute, STILL_UM))
    writer.close()
    check, ledger = checked(path)
    check.displacements()
    count = ledger.counts["displacements_once"]
    assert (count.checked, count.violated) == (4, 1)


def test_a_change_of_state_that_nobody_knows_is_found(tmp_path: Path) -> None:
    path = tmp_path / "history.sqlite"
    writer = HistoryWriter(path, clock=StillClock(), machine=SMALL)
    writer.start()
    for kind, text in (
        ("start", "HOLD: the CNC still applies an offset"),
        ("state", "HOLD -> ACTIVE: following"),
        ("state", "FAULT -> ACTIVE: nobody knows why"),
        ("start", "ACTIVE: at once"),
    ):
        writer.event(kind, text)
    writer.close()
    check, ledger = checked(path)
    check.changes_of_state()
    count = ledger.counts["changes_of_state_known"]
    assert (count.checked, count.violated) == (4, 2)
    assert "FAULT -> ACTIVE (nobody knows why)" in count.examples[0]


def test_a_probe_value_that_is_not_stored_is_found(tmp_path: Path) -> None:
    path = tmp_path / "history.sqlite"
    writer = HistoryWriter(path, clock=StillClock(), machine=SMALL)
    writer.start()
    for deviation_um, accepted in ((4.0, True), (6.0, False)):
        writer.probe(
            ProbeSample(
                time=StillClock().now(),
                axis="z",
                deviation_um=deviation_um,
                applied_um=0.0,
                thermal_error_um=0.0,
                reference_id="r1",
                accepted=accepted,
                reason="",
            )
        )
    writer.close()
    check, ledger = checked(path)
    check.probes([Probe(answered_s=1.0, axis=3, deviation_um=um) for um in (4.0, 6.0)], ["x", "y", "z"])
    assert (ledger.counts["probes_kept"].checked, ledger.counts["probes_kept"].violated) == (2, 1)
