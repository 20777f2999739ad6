"""The history when the process is killed, and when the disk is full."""

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import history_records as make
import numpy as np
import pytest
from history_records import EPOCH_S, SMALL, StillClock
from tidied_store import housekeeping
from write_history import degc_of

from config.schema.service import HistoryConfig
from daemon.history.database import connect_reader
from daemon.history.reader import HistoryReader
from daemon.history.writer import HistoryWriter
from models.records import WriteOutcome

REPOSITORY = Path(__file__).resolve().parents[2]
SUPPORT = REPOSITORY / "tests" / "support"
Said = dict[str, object]


@contextmanager
def writing_process(mode: str, store: Path, *before: str) -> Iterator[subprocess.Popen[str]]:
    command = [*before, sys.executable, str(SUPPORT / "write_history.py"), mode, str(store)]
    environment = os.environ | {"PYTHONPATH": str(REPOSITORY)}
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def kill_when(mode: str, store: Path, enough: Callable[[list[Said]], bool]) -> list[Said]:
    """Kill the process as soon as what it said is enough; return all it said, to the last byte."""
    said: list[Said] = []
    with writing_process(mode, store) as process:
        assert process.stdout is not None and process.stderr is not None
        for line in process.stdout:
            said.append(json.loads(line))
            if enough(said):
                break
        else:
            pytest.fail(f"ended by itself: {process.stderr.read()}")
        process.send_signal(signal.SIGKILL)
        said += [json.loads(line) for line in process.stdout if line.endswith("\n")]
        assert process.wait() == -signal.SIGKILL
    return said


def assert_whole(store: Path) -> None:
    with closing(connect_reader(store)) as connection:
        assert connection.execute("PRAGMA integrity_check").fetchall() == [("ok",)]


@pytest.mark.parametrize("cycles", [1, 40, 90])
def test_no_acknowledged_cycle_is_lost_by_a_kill(tmp_path: Path, cycles: int) -> None:
    store = tmp_path / "history.sqlite"

    def enough(so_far: list[Said]) -> bool:
        return sum("number" in one for one in so_far) >= cycles and any("intent" in one for one in so_far)

    said = kill_when("cycles", store, enough)
    acknowledged = max(int(str(one["number"])) for one in said if "number" in one)
    intents = [one for one in said if "intent" in one]
    assert_whole(store)
    with HistoryReader(store) as reader:
        in_table = reader.acknowledged()["spindle"]
        found = reader.temperatures([13, 11, 12], EPOCH_S, EPOCH_S + 1e6)
        unsettled = reader.unsettled_writes()
        settled = {w.write_id for w in reader.writes(0, 2e9) if w.outcome is WriteOutcome.VERIFIED}
    assert in_table >= acknowledged
    assert found.number.tolist() == list(range(1, in_table + 1)), "every cycle once, up to the last one"
    np.testing.assert_array_equal(found.degc, [degc_of(number) for number in range(1, in_table + 1)])
    assert 1 <= len(unsettled) <= 2, "what was open when the process died is known"
    assert unsettled[-1].write_id >= int(str(intents[-1]["intent"]))
    assert settled >= set(range(1, int(str(intents[-1]["settled"] or 0))))


@pytest.mark.parametrize("hours", [1, 3, 5])
def test_kill_while_packing_neither_loses_nor_doubles(tmp_path: Path, hours: int) -> None:
    store = tmp_path / "history.sqlite"
    writer = HistoryWriter(store, clock=StillClock(), machine=SMALL)
    writer.start()
    for k in range(6 * 360):
        writer.temperatures(None, make.cycle("spindle", k, EPOCH_S + 10 * k, degc_of(k)))
        writer.cnc_sample(make.cnc_sample(EPOCH_S + 10 * k))
    writer.close()
    kill_when("pack", store, lambda so_far: sum("hour" in one for one in so_far) >= hours)
    for _ in ("as the kill left it", "packed to the end"):
        assert_whole(store)
        with HistoryReader(store) as reader:
            found = reader.temperatures([13], EPOCH_S, EPOCH_S + 1e6)
            cnc = reader.cnc(EPOCH_S, EPOCH_S + 1e6)
        assert found.number.tolist() == list(range(6 * 360))
        assert (cnc.time_s - EPOCH_S).tolist() == [10.0 * k for k in range(6 * 360)]
        housekeeping(store, HistoryConfig(), EPOCH_S + 1e6)


def run_to_the_end(mode: str, store: Path, *before: str) -> tuple[list[Said], str]:
    with writing_process(mode, store, *before) as process:
        out, err = process.communicate(timeout=120)
    return [json.loads(line) for line in out.splitlines()], err


def assert_survived(said: list[Said], store_text: str) -> None:
    problems = [str(one["problem"]) for one in said if one.get("problem")]
    assert problems and store_text in problems[0], problems
    assert "Records wait in memory" in problems[0]
    (waited,) = [one for one in said if "waiting" in one]
    assert int(str(waited["waiting"])) >= 100, "what came while the disk was full waits"
    assert said[-1] == {"closed": True, "dropped": {}, "problem_left": ""}
    last_problem = [one for one in said if "problem" in one][-1]
    assert last_problem["problem"] == "", "and it says when it works again"


def check_all_cycles(store: Path, said: list[Said]) -> None:
    (last,) = [int(str(one["last"])) for one in said if "last" in one]
    acknowledged = [one["number"] for one in said if "number" in one]
    assert_whole(store)
    with HistoryReader(store) as reader:
        found = reader.temperatures([13], EPOCH_S, EPOCH_S + 1e6)
        notes = reader.events(0, 2e9)
        assert reader.row_count("cnc") == 4 * last
    assert found.number.tolist() == acknowledged == list(range(1, last + 1))
    assert len(notes) == 20


@pytest.mark.skipif(os.geteuid() != 0 or shutil.which("unshare") is None, reason="only root can mount a small disk")
def test_full_disk_is_reported_and_outlived(tmp_path: Path) -> None:
    store, copy = tmp_path / "disk" / "history.sqlite", tmp_path / "copy"
    store.parent.mkdir()
    script = tmp_path / "on_small_disk.sh"
    script.write_text(
        f'mount -t tmpfs -o size=2m none "{store.parent}" || exit 77\n"$@"\n'
        f'status=$?\ncp -r "{store.parent}" "{copy}"\nexit $status\n'
    )
    with writing_process("ballast", store, "unshare", "-m", "sh", str(script)) as process:
        out, err = process.communicate(timeout=120)
    if process.returncode == 77 or "unshare" in err:
        pytest.skip(f"a small disk cannot be mounted here: {err.strip()}")
    said = [json.loads(line) for line in out.splitlines()]
    assert said, err
    assert_survived(said, "the disk is full; free space on it")
    check_all_cycles(copy / "history.sqlite", said)


def test_what_a_killed_daemon_left_is_read_on_a_full_disk(tmp_path: Path) -> None:
    store = tmp_path / "history.sqlite"
    killed = kill_when("cycles", store, lambda so_far: len(so_far) >= 10)
    intents = [int(str(one["intent"])) for one in killed if "intent" in one]
    ((one,), err) = run_to_the_end("recall", store)
    left = one["left"]
    assert isinstance(left, list) and len(left) <= 2, err
    assert max(intents) <= int(str(one["last"])) and one["last"] in left, "the intents of the log count as well"
    assert_whole(store)
    with HistoryReader(store) as reader:
        assert [record.write_id for record in reader.unsettled_writes()] == left
