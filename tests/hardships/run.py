"""Hardships on real wires, each as often as it takes, in one table.

    make hardships                                          all of them at length: an hour and a half
    python tests/hardships/run.py --quick                   each a few times: some minutes
    python tests/hardships/run.py --only kills --kills 100 --json -

A simulated machine and the daemon run as processes on serial lines, OPC UA and a store on a disk of its own. Exit
status 0 when everything held and nothing acknowledged was lost, 1 otherwise, 2 for bad usage. The random moments come
from --seed, which is printed. Ctrl-C ends a row early and goes on with the next.
"""

import argparse
import contextlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent / "support"), str(HERE.parents[1])]

import clock_rows  # noqa: E402
import process_rows  # noqa: E402
import store_rows  # noqa: E402
from account import Row, Unavailable, table  # noqa: E402
from rig import SPEED, Rig, at_work, machine_and_daemon  # noqa: E402

from daemon.simulation import SimulationError  # noqa: E402

STARTS = 5
OWN_MOUNTS = "TOOLPOINT_HARDSHIPS_OWN_MOUNTS"
CUTS = {
    "torn": store_rows.torn,
    "lost": store_rows.lost,
    "flipped": store_rows.flipped,
    "unsynced": store_rows.unsynced,
}
Play = Callable[[Rig, Row], None]


def plays(options: argparse.Namespace) -> dict[str, tuple[Play, bool]]:
    """Return what is played, by name, and whether it needs the computer's own clock.

    The moments of a row are the same whatever is played before it.
    """

    def moments(name: str) -> random.Random:
        return random.Random(f"{options.seed} {name}")

    quick = options.quick
    few = 1 if quick else 5
    found: dict[str, tuple[Play, bool]] = {
        "kills": (partial(process_rows.kills, count=options.kills, moments=moments("kills")), False),
    }
    for name, cut in CUTS.items():
        cuts = partial(store_rows.power_cuts, count=1 if quick else 25, moments=moments(name), cut=cut)
        found[f"power cut, {name}"] = (cuts, False)
    pages = partial(store_rows.damaged_pages, count=1 if quick else 25, moments=moments("pages"))
    found["pages of the store damaged"] = (pages, False)
    found["full disk"] = (partial(store_rows.full_disk, count=few), False)
    found["switched off on a full disk"] = (partial(store_rows.switched_off_on_full_disk, count=few), False)
    found["read-only disk"] = (partial(store_rows.read_only_disk, count=few), False)
    found["descriptors exhausted"] = (partial(process_rows.descriptors_exhausted, count=few), False)
    found["1100 half-sent requests on each socket"] = (partial(process_rows.half_sent, count=few), False)
    found["silent half-open connection to the CNC"] = (partial(process_rows.half_open, count=few), False)
    found["four spinners"] = (partial(process_rows.spinners, seconds=5.0 if quick else 60.0), False)
    found["two daemons on one CNC, on one store"] = (partial(process_rows.second_daemon, count=few), False)
    found["ports of two lines swapped"] = (partial(process_rows.ports_swapped, count=few), False)
    found["a line that brings too much"] = (partial(process_rows.flooded, seconds=10.0 if quick else 60.0), False)
    found["stopped for 10 s"] = (partial(process_rows.stopped, seconds=10.0), False)
    found["stopped for 10 min"] = (partial(process_rows.stopped, seconds=600.0), False)
    found["calendar set by hours and days"] = (
        partial(clock_rows.steps, steps_s=clock_rows.STEPS_S[2:4] if quick else clock_rows.STEPS_S),
        True,
    )
    found["summer time begins and ends"] = (clock_rows.summer_time, True)
    if quick:
        del found["stopped for 10 min"]
    return {name: what for name, what in found.items() if any(part in name for part in options.only or [name])}


def play_all(options: argparse.Namespace) -> list[Row]:
    """Play everything; rows that need the same clock share a machine, which is built anew after an accident."""
    wanted = plays(options)
    rows = {name: Row(name=name) for name in wanted}
    for own_clock in (False, True):
        left = [name for name, (_, own) in wanted.items() if own is own_clock]
        while left:
            with machine(own_clock) as rig:
                while left:
                    name = left.pop(0)
                    if not play(rig, rows[name], wanted[name][0], options.keep):
                        break
    return list(rows.values())


@contextlib.contextmanager
def machine(own_clock: bool) -> Iterator[Rig]:
    """Start a machine with its daemon; on the computer's own clock it is in real time.

    A computer that is busy with other things may need several starts until both are ready together.
    """
    speed, change = (1.0, clock_rows.real_time) if own_clock else (SPEED, at_work)
    with contextlib.ExitStack() as stack:
        for left in reversed(range(STARTS)):
            try:
                rig = stack.enter_context(machine_and_daemon(speed=speed, change=change))
                break
            except (SimulationError, AssertionError) as error:
                _say(str(error))
                if not left:
                    raise
        yield rig


def play(rig: Rig, row: Row, what: Play, keep: Path | None) -> bool:
    """Play one row; return whether the machine is still usable."""
    began_s = time.monotonic()

    def interrupt(*_: object) -> None:
        row.interrupted = True

    signal.signal(signal.SIGINT, interrupt)
    try:
        what(rig, row)
    except Unavailable as error:
        row.skipped = str(error)
    except Exception as error:  # the other rows are played all the same
        row.check("the row could be played to its end", False, f"{type(error).__name__}: {error}")
    _say(f"{row.name}: {row.runs} runs, {len(row.violations)} not so, {time.monotonic() - began_s:.0f} s")
    for violation in row.violations:
        _say(f"  {violation}")
    if row.violations and keep is not None:
        _keep(rig, keep / row.name.replace(" ", "-"))
    return not row.violations


def _keep(rig: Rig, folder: Path) -> None:
    """Copy logs, configuration and store."""
    folder.mkdir(parents=True, exist_ok=True)
    for path in (*rig.directory.iterdir(), *rig.store.parent.iterdir()):
        if path.is_file() and not path.is_symlink():
            shutil.copyfile(path, folder / path.name)


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def in_own_mounts() -> None:
    """Begin again in a mount namespace of our own, so that no small disk outlives us."""
    if os.geteuid() != 0 or OWN_MOUNTS in os.environ or shutil.which("unshare") is None:
        return
    if subprocess.run(["unshare", "--mount", "true"], check=False, capture_output=True).returncode == 0:
        os.environ[OWN_MOUNTS] = "1"
        os.execvp("unshare", ["unshare", "--mount", sys.executable, *sys.argv])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="small counts")
    parser.add_argument("--kills", type=int, help="kills of the daemon (1000, quick: 5)")
    parser.add_argument("--only", action="append", help="only rows whose name contains this; may be given again")
    parser.add_argument("--seed", type=int, default=random.SystemRandom().randrange(2**31))
    parser.add_argument("--json", metavar="FILE", help="the table as JSON; - for standard output")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="keep store and logs of what did not hold")
    options = parser.parse_args()
    options.kills = options.kills or (5 if options.quick else 1000)
    in_own_mounts()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # what runs is ended on the way out
    _say(f"seed {options.seed}")
    rows = play_all(options)
    content = {"seed": options.seed, "rows": {row.name: row.numbers() for row in rows}}
    if options.json == "-":
        print(json.dumps(content, indent=2, allow_nan=False))
    else:
        print(table(rows))
        if options.json:
            Path(options.json).write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", "utf-8")
    return 1 if any(row.violations or row.lost for row in rows) else 0


if __name__ == "__main__":
    sys.exit(main())
