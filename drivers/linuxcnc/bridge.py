"""Runs beside LinuxCNC, with the Python modules that come with it, and answers one JSON line with one JSON line.

The driver starts it with the system's Python and hands it this text, so nothing here may import from Toolpoint. First
line in: `{nml_file, clock}`. Then requests with an `id`, which the answer repeats: `read` with the numbers of analog
inputs and outputs, `write` with pairs of input and value. It ends when its input ends or when LinuxCNC does.
"""

import json
import os
import signal
import sys
import time
import zlib
from pathlib import Path
from typing import Any

START_S = 0.5
"""LinuxCNC's status is empty for so long at most after its start [s]."""
HANGS_AFTER_S = 60
"""A request takes less, or LinuxCNC hangs; then the bridge ends, which its daemon, another user, may not do [s]."""
COORDINATE_SYSTEMS = (540, 550, 560, 570, 580, 590, 591, 592, 593)
"""G54 to G59.3 as the status has them among the active codes."""


def milltask() -> int:
    """Return the process of LinuxCNC's task program, 0 where none runs."""
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            if (entry / "comm").read_text().strip() == "milltask":
                return int(entry.name)
        except OSError:
            continue
    return 0


def started(process: int) -> int:
    """Return a number that another start of LinuxCNC does not have."""
    ticks = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[19]
    boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    return zlib.crc32(f"{boot}:{ticks}".encode()) & 0x7FFFFFFF


def active_system(codes: tuple[int, ...]) -> int:
    """Return which coordinate system is active, 1 for G54; the status has 0 until it is set for the first time."""
    return next((number for number, code in enumerate(COORDINATE_SYSTEMS, 1) if code in codes), 0)


class Bridge:
    """One connection to LinuxCNC's status and to the pins of its motion controller."""

    def __init__(self, first: dict[str, Any]) -> None:
        self.process = milltask()
        if not self.process:
            raise RuntimeError("LinuxCNC does not run on this computer")
        self.power_on = started(self.process)
        import hal  # type: ignore[import-not-found]
        import linuxcnc  # type: ignore[import-not-found]

        linuxcnc.nmlfile = first["nml_file"]
        self.hal = hal
        self.component = hal.component(f"toolpoint-{os.getpid()}")
        self.component.ready()
        self.stat = linuxcnc.stat()
        self.stat.poll()
        begun = time.monotonic()
        while not self.stat.ini_filename and time.monotonic() < begun + START_S:
            time.sleep(0.02)
            self.stat.poll()
        if not self.stat.ini_filename:
            raise RuntimeError("LinuxCNC has not begun yet")
        self.clock = first["clock"]
        self.program = self.stat.file
        self.machine = linuxcnc.ini(self.stat.ini_filename).find("EMC", "MACHINE") or self.stat.ini_filename

    def pin(self, kind: str, index: int) -> float:
        """Return the value of an analog input or output."""
        return float(self.hal.get_value(f"motion.analog-{kind}-{index:02d}"))

    def read(self, inputs: list[int], outputs: list[int]) -> dict[str, Any]:
        """Return pins and state of one moment."""
        if milltask() != self.process:
            raise RuntimeError("LinuxCNC has ended")
        for _ in range(3):
            found = [self.pin("out", index) for index in outputs]
            self.stat.poll()
            if found == [self.pin("out", index) for index in outputs]:
                break
        stat = self.stat
        if stat.call_level == 0:  # else it is the file of the subroutine that is read, such as the guard's
            self.program = stat.file
        return {
            "in": [self.pin("in", index) for index in inputs],
            "out": found,
            "clock": self.pin("in", self.clock),
            "power_on": self.power_on,
            "task_state": stat.task_state,
            "task_mode": stat.task_mode,
            "interp_state": stat.interp_state,
            "file": self.program,
            "offset": stat.g5x_index or active_system(stat.gcodes),
            "tool": stat.tool_in_spindle,
            "speed": abs(stat.spindle[0]["speed"]) if stat.spindles else None,
            "position": list(stat.actual_position),
            "units_per_mm": stat.linear_units,
            "axes": stat.axis_mask,
        }

    def write(self, values: list[tuple[int, float]]) -> dict[str, Any]:
        """Set analog inputs one after the other; end with the first that is refused, which is named with the reason."""
        for place, (index, value) in enumerate(values):
            try:
                self.hal.set_p(f"motion.analog-in-{index:02d}", repr(value))
                if self.pin("in", index) != value:
                    return {"refused": place, "why": "it holds another value afterwards"}
            except RuntimeError as error:
                return {"refused": place, "why": str(error)}
        return {}


def answered(bridge: Bridge, request: dict[str, Any]) -> dict[str, Any]:
    if request["do"] == "read":
        return bridge.read(request["in"], request["out"])
    return bridge.write([(index, float(value)) for index, value in request["values"]])


def main() -> int:
    """Answer until the input ends."""
    bridge = None
    talk = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # LinuxCNC's libraries print where they like
    try:
        for line in sys.stdin:
            request = json.loads(line)
            signal.alarm(HANGS_AFTER_S)
            try:
                if bridge is None:
                    bridge = Bridge(request)
                    answer = {"machine": bridge.machine}
                else:
                    answer = answered(bridge, request)
            except (RuntimeError, SystemError, ImportError, OSError) as error:
                answer = {"error": str(error)}
            talk.write(json.dumps({"id": request["id"], **answer}) + "\n")
            talk.flush()
            signal.alarm(0)
            if "error" in answer:
                return 1
    finally:
        if bridge is not None:
            bridge.component.exit()
    return 0


if __name__ == "__main__":
    sys.exit(main())
