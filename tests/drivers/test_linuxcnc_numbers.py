"""Numbers that LinuxCNC does not have itself: of programs, of work offsets, of pins; and whose guard its text is."""

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
from importlib.resources import files
from pathlib import Path

import pytest
from pydantic import ValidationError
from scripted_machine import cnc_config, configuration

from config.schema import Configuration
from config.schema.compensation import AxisConfig
from drivers.bridge_link import BridgeLink
from drivers.guard.linuxcnc import linuxcnc_text
from drivers.guard.programs import guard_text
from drivers.guard.text import GuardTextError
from drivers.linuxcnc.cnc import program_number, work_offset
from drivers.linuxcnc_pins import Pins


def test_programs_and_offsets_have_numbers() -> None:
    assert [program_number(path) for path in ("/a/o1000.ngc", "/a/1000.ngc", "")] == [1000, 1000, 0]
    assert program_number("/a/part.ngc") != program_number("/b/part.ngc") > 10_000_000
    assert [work_offset(index) for index in (0, 1, 6, 9, 12)] == [0, 54, 59, 593, 0]


def test_every_macro_of_the_map_has_a_pin_of_its_own_behind_the_clock() -> None:
    config = cnc_config(linuxcnc={"analog_in": 4, "analog_out": 10})
    pins = Pins.of(config)
    assert pins.clock == 4 and list(pins.inputs.values()) == list(range(5, 13)) and len(pins) == 16
    assert {**pins.inputs, **pins.outputs}.keys() == set(config.macros.block)
    assert list(pins.outputs.values()) == list(range(10, 16)) and set(pins.outputs) == set(range(510, 516))


def test_the_guard_of_linuxcnc_is_for_linuxcnc_and_no_other_is() -> None:
    axes = {"Z": AxisConfig(absolute_bound_um=50.0, slew_um_per_min=2.0, step_um=2.0)}
    for changes in ({"focas": {"host": "x"}, "guard": {"dialect": "linuxcnc"}}, {"linuxcnc": {}, "guard": {}}):
        with pytest.raises(ValidationError, match=r"must be (linuxcnc|fanuc) for this control"):
            cnc_config(**changes)
    with pytest.raises(GuardTextError, match=r"is for cnc\.driver linuxcnc"):
        linuxcnc_text(cnc_config(focas={"host": "x"}), axes)
    config = cnc_config(linuxcnc={})
    with pytest.raises(GuardTextError, match="needs the pins of"):
        guard_text(config.macros, axes, config.guard)
    numbered = cnc_config(linuxcnc={}, guard={"axes": {"Z": {"letter": "W", "number": 4}}, "dialect": "linuxcnc"})
    with pytest.raises(GuardTextError, match=r"axes\.Z\.number: axis W of LinuxCNC is 9, not 4"):
        linuxcnc_text(numbered, axes)


@pytest.mark.parametrize("key", ["tool_counter", "positioning_counter"])
def test_a_counter_that_has_no_pin_is_refused_and_not_silently_never_counted(tmp_path: Path, key: str) -> None:
    plain = configuration(tmp_path)
    counting = {"reference": {key: 561}}
    compensation = plain.compensation.model_dump(exclude_none=True) | counting
    said = plain.model_dump(exclude_none=True) | {"compensation": compensation}
    Configuration.model_validate(said)
    with pytest.raises(ValidationError, match=r"#561 has no pin of LinuxCNC.*handshake"):
        Configuration.model_validate(said | {"cnc": cnc_config(linuxcnc={}).model_dump(exclude_none=True)})


async def test_a_bridge_that_the_daemon_may_not_end_keeps_nothing_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """By sudo it is another user's: the system says so, and the link is closed all the same."""
    link, groups = await BridgeLink.start(["/bin/sh", "-c", "sleep 30"], "", "LinuxCNC", ""), []

    def not_permitted(group: int, _signal: int) -> None:
        groups.append(group)
        raise PermissionError(errno.EPERM, "Operation not permitted")

    with monkeypatch.context() as patched:
        patched.setattr(os, "killpg", not_permitted)
        link.abort("closed")
        await link.ended()
    os.killpg(*groups, signal.SIGKILL)
    await link.ended()


def test_a_bridge_in_which_linuxcnc_hangs_ends_itself(tmp_path: Path) -> None:
    """Nobody else may, where it runs as LinuxCNC's user by sudo."""
    shutil.copy("/bin/sleep", tmp_path / "milltask")
    (tmp_path / "linuxcnc.py").touch()
    (tmp_path / "hal.py").write_text("import time\ndef component(name):\n    time.sleep(20)\n")
    text = files("drivers.linuxcnc").joinpath("bridge.py").read_text("utf-8")
    text = text.replace("HANGS_AFTER_S = 60", "HANGS_AFTER_S = 1")
    command, environment = [sys.executable, "-c", text], {"PYTHONPATH": str(tmp_path)}
    with subprocess.Popen([tmp_path / "milltask", "20"]) as milltask:
        first = json.dumps({"id": 1, "nml_file": "none.nml", "clock": 0}) + "\n"
        ended = subprocess.run(command, check=False, input=first, text=True, env=environment, timeout=15)
        milltask.kill()
    assert ended.returncode == -signal.SIGALRM
