"""The terminal view of a status picture."""

import io
import json
import os
import pty
import re
import select
import signal
import socket
import subprocess
import sys
import threading
import time

import pytest
from rich.console import Console
from rich.live import Live

from daemon.monitor.view import status_view, truth_panel
from daemon.telemetry.latency import PUBLISHED_DELAY_S

AXIS = {
    "estimate_from": "Z1",
    "wanted": True,
    "enabled": True,
    "thermal_error_um": -12.34,
    "requested_um": 12.34,
    "written_um": 12.3,
    "applied_um": 12.25,
    "bound_um": 30.0,
    "slew_um_per_min": 2.0,
}
DELAY = {"mean": 0.003, "p50": 0.003, "p99": 0.0045, "p999": 0.005, "max": 0.006, "samples": 9}
PICTURE = {
    "machine": "a machine",
    "output": {
        "state": "HOLD",
        "reason": "temperatures are stale (61 s old)",
        "since_s": 5.0,
        "alarm": "held for 400 s",
        "phase": "cutting",
        "limits_hit": [],
        "weight": 0.5,
        "guard_silent_s": 0.0,
        "notices": [],
        "insecure_writes": True,
        "writable_model_directory": True,
    },
    "axes": {"z": AXIS, "x": AXIS | {"estimate_from": None}},
    "model": {"model_id": None, "problem": "model.json: nobody has released this model"},
    "reference": {"id": "r", "source": "O1000 N100", "age_s": 90.0, "set_utc_s": 0.0},
    "tools_set": [2, 17],
    "temperatures": {
        "usable": 300,
        "total": 302,
        "labels_degc": {"A": 21.25, "Room": None, "IR": 23.0},
        "not_good": {"17": "not received"},
        "not_good_count": 2,
    },
    "cnc": {
        "program": 1000,
        "sequence_number": 200,
        "mode": "memory",
        "run": "start",
        "alarm": True,
        "spindle_speed_rpm": 12000.0,
        "motor_temperature_degc": 41.0,
        "tool_number": 1,
        "work_offset": 54,
    },
    "writes": {"sent": 10, "verified": 9, "refused": 0},
    "latency_s": {"measurement": DELAY, "feedback": DELAY, "total": DELAY, "published": PUBLISHED_DELAY_S},
    "links": [
        {"name": "cnc", "up": True, "problem": "", "attempts": 1, "failures": 0},
        {"name": "latsis spindle", "up": False, "problem": "no such port", "attempts": 3, "failures": 3},
    ],
    "cycles": {"received": 5, "incomplete": 1},
}


def shown(renderable, width=160):
    console = Console(file=io.StringIO(), width=width, force_terminal=False)
    console.print(renderable)
    return console.file.getvalue()


def test_what_matters_is_on_the_screen():
    text = shown(status_view(PICTURE, footer="the footer"))
    for words in (
        *("HOLD", "temperatures are stale", "held for 400 s", "cutting", "insecure connection", "O1000 N100"),
        "tools set: T2, T17",
        *("nobody has released this model", "not for a real machine: allow_writable_model_directory"),
        *("-12.3", "+12.3", "no model for this axis", "300 of 302", "sensor 17", "ALARM", "9 of 10"),
        *("> 20 s", "1.2 s", "24.7 s", "latsis spindle", "no such port", "5 line cycles, 1 incomplete", "the footer"),
    ):
        assert words in text, words


def test_the_reason_of_a_fault_is_said_once():
    why = "macro #502 holds 3, we wrote 0"
    alarm = f"FAULT: {why}; `toolpoint acknowledge` clears it"
    text = shown(
        status_view(PICTURE | {"output": PICTURE["output"] | {"state": "FAULT", "reason": why, "alarm": alarm}})
    )
    assert text.count(why) == 1 and "`toolpoint acknowledge` clears it" in text


def test_a_machine_without_a_model_is_not_told_that_one_was_refused():
    assert "no model in force: model.json: nobody has released this model" in shown(status_view(PICTURE))


def test_where_the_machine_stands_is_said_in_english():
    at_rest = PICTURE | {"output": PICTURE["output"] | {"phase": "safe point"}}
    assert "the machine is at a safe point" in shown(status_view(at_rest))
    assert "the machine is" not in shown(status_view(at_rest | {"cnc": None})), "nobody knows"


@pytest.mark.parametrize(
    ("unknown", "words"), [("spindle_speed_rpm", "–, motor 41 °C"), ("motor_temperature_degc", "motor –")]
)
def test_what_a_control_does_not_tell_is_a_dash(unknown, words):
    """A Haas, LinuxCNC, or a FANUC without the number of the diagnosis: `toolpoint status` ended with a traceback."""
    text = shown(status_view(PICTURE | {"cnc": PICTURE["cnc"] | {unknown: None}}))
    assert words in text and "O1000 N200" in text


@pytest.mark.parametrize("width", [80, 100, 200])
def test_a_problem_is_shown_whole_and_no_word_of_it_is_cut(width):
    problem = (
        "line spindle: port /dev/serial/by-path/pci-0000:00-usb-0:1.2:1.0 does not exist: plug the adapter in, or "
        "correct `port` in the configuration (`ls -l /dev/serial/by-id` lists the ports that are there)"
    )
    lost = {"name": "latsis spindle", "up": False, "problem": problem, "attempts": 3, "failures": 3}
    text = shown(status_view(PICTURE | {"links": [lost]}), width)
    missing = [word for word in problem.split() if word not in text]
    assert missing == []
    for words in ("1/min,", "motor", "measurement", "9 of 10", "insecure connection", "published"):
        assert words in text, words


@pytest.mark.parametrize("width", [40, 80, 200])
def test_before_anything_is_known_it_renders_too(width):
    nothing = dict.fromkeys(("thermal_error_um", "requested_um", "written_um", "applied_um"))
    unknown = {"mean": None, "p50": None, "p99": None, "p999": None, "max": None, "samples": 0}
    picture = PICTURE | {
        "axes": {"z": AXIS | nothing},
        "reference": None,
        "temperatures": None,
        "cnc": None,
        "latency_s": {"measurement": unknown, "feedback": unknown, "total": unknown, "published": PUBLISHED_DELAY_S},
    }
    text = shown(status_view(picture), width)
    assert "reference" in text and "–" in text


@pytest.mark.parametrize("width", [40, 59, 60, 61, 70, 74, 75, 76, 80])
def test_headings_and_numbers_of_the_axes_are_whole_at_every_width(width):
    axes = {"x": AXIS | {"estimate_from": None}, "y": AXIS, "z": AXIS | {"bound_um": 100.0, "requested_um": -100.0}}
    lines = shown(status_view(PICTURE | {"axes": axes}), width).splitlines()
    assert not [line for line in lines if "…" in line]
    assert [line for line in lines if line.startswith("z ") and "-12.3" in line and "-100.0" in line]


ROOMY = PICTURE | {
    "output": PICTURE["output"] | {"state": "ACTIVE", "reason": "following the estimate", "alarm": "", "weight": 1.0},
    "model": {"model_id": "ridge", "problem": ""},
    "tools_set": [],
    "reference": {"id": "r", "source": "request 4 of the NC program (reference)", "age_s": 5000.0, "set_utc_s": 0.0},
    "axes": {
        "x": AXIS | {"estimate_from": None},
        "y": AXIS | {"estimate_from": "Y1", "bound_um": 60.0},
        "z": AXIS | {"baseline_um": 20.4},
    },
    "temperatures": {
        "usable": 302,
        "total": 302,
        "labels_degc": dict.fromkeys(("Room", "A", "B", "C", "D", "E", "F", "IR"), 22.43),
        "not_good": {},
    },
    "links": [
        {"name": name, "up": True, "problem": ""}
        for name in ("latsis spindle", "latsis saddle", "latsis fixed", "cnc", "displacement files")
    ],
}
TRUTH = {"time_s": 5400.0, "truth": {a: {"uncompensated_um": -31.2, "compensated_um": 1.3} for a in "xyz"}}
TRAIL = {axis: [(-30.0, 1.0)] * 300 for axis in "xyz"}


def drawn(view, width, height):
    """Return the lines that a terminal shows of the live view, drawn as the commands draw it."""
    console = Console(file=io.StringIO(), width=width, height=height, force_terminal=True, color_system=None)
    with Live(view, console=console, screen=True, auto_refresh=False):
        pass
    frame = console.file.getvalue().partition("\x1b[?1049l")[0].rpartition("\x1b[H")[2]
    return re.sub("\x1b\\[[0-9;?]*[A-Za-z]", "", frame).splitlines()


def test_where_lines_are_few_the_live_view_keeps_the_link_that_is_down_and_says_that_it_leaves_out():
    lost = {"name": "cnc", "up": False, "problem": "opc.tcp://192.0.2.1:4840/ does not answer: check the network " * 3}
    picture = ROOMY | {"links": [*ROOMY["links"], lost]}
    text = " ".join(" ".join(drawn(status_view(picture, footer="Ctrl-C ends", live=True), 80, 20)).split())
    assert "○ cnc" in text and text.count("check the network") == 3 and "Ctrl-C ends" in text
    assert "taller terminal" in text and "24.7 s" not in text


@pytest.mark.parametrize(("width", "height"), [(80, 24), (100, 30), (120, 40)])
def test_the_whole_view_fits_the_terminal_with_nothing_cut_off(width, height):
    footer = "in a browser: http://127.0.0.1:8080/ · Ctrl-C ends"
    text = drawn(status_view(ROOMY, [truth_panel(TRUTH, TRAIL)], footer, live=True), width, height)
    assert len(text) <= height and max(len(line.rstrip()) for line in text) <= width
    shown = "\n".join(text)
    assert "…" not in shown and "taller terminal" not in shown
    for words in ("-31.2", "within bound", "+30", "IR 22.43", "302 of 302 usable", "24.7 s", "displacement files"):
        assert words in shown, words
    assert "by another rig" in shown and "Ctrl-C ends" in shown
    assert "requested = what was applied at the reference (z +20.4) - estimated" in shown


def answer(listening: socket.socket, reason: str, times: int) -> None:
    """Be the daemon for so many questions, then end."""
    picture = ROOMY | {"output": ROOMY["output"] | {"reason": reason}}
    for connection in iter(lambda: listening.accept()[0], None):
        with connection, connection.makefile("rb") as questions:
            for _ in questions:
                connection.sendall(json.dumps({"ok": True} | picture).encode() + b"\n")
                times -= 1
                if not times:
                    listening.close()
                    return


def test_the_live_view_outlasts_a_restart_of_the_daemon_and_says_that_nothing_answers(tmp_path):
    path, (person, terminal) = tmp_path / "s", pty.openpty()
    seen, spoken = "", ["before", "since the restart"]
    listening = socket.create_server(str(path), family=socket.AF_UNIX)
    threading.Thread(target=answer, args=(listening, spoken[0], 3), daemon=True).start()
    command = [sys.executable, "-P", "-m", "daemon.cli", "monitor", "--socket", str(path)]
    with subprocess.Popen(
        command, stdin=terminal, stdout=terminal, stderr=terminal, env={**os.environ, "TERM": "xterm"}
    ) as monitor:
        try:
            until_s = time.monotonic() + 60.0
            while spoken[1] not in seen and monitor.poll() is None and time.monotonic() < until_s:
                if select.select([person], [], [], 0.1)[0]:
                    seen += os.read(person, 65536).decode(errors="replace")
                if "NO ANSWER" in seen and path.exists():
                    path.unlink()
                    listening = socket.create_server(str(path), family=socket.AF_UNIX)
                    threading.Thread(target=answer, args=(listening, spoken[1], 9999), daemon=True).start()
                    path = tmp_path / "not made twice"
            assert "NO ANSWER" in seen and spoken[1] in seen, seen[-2000:]
            assert "the daemon closed the connection" in seen
            monitor.send_signal(signal.SIGINT)
            assert monitor.wait(20.0) == 0
        finally:
            monitor.kill()
            os.close(person)
            os.close(terminal)
