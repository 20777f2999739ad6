"""LinuxCNC on this computer: status and analog pins by a bridge, a child process with LinuxCNC's own Python modules.

Analog inputs of the motion controller stand for macro variables that the daemon writes (a program reads them by M66),
outputs, set by M68, for those of the NC program; these are vacant until the guard has run since LinuxCNC's start.
"""

import math
import re
import zlib
from collections.abc import Mapping, Sequence
from importlib.resources import files
from typing import Any

from config.schema.cnc import CncConfig
from config.schema.cnc_drivers import LinuxcncConfig
from drivers.bridge_link import BridgeError, BridgeLink
from drivers.clock import Clock
from drivers.contract import MM_PER_INCH, Capability, FatalDriverError, NotSentError, position_mm
from drivers.linked_cnc import LinkedCnc
from drivers.linuxcnc_pins import VACANT, Pins
from models.records import CncMode, CncRun, CncSample

NAME = "LinuxCNC"
RUNS_AS = "cnc.linuxcnc.command must run as LinuxCNC's own user"
MODES = {1: CncMode.JOG, 2: CncMode.MEMORY, 3: CncMode.MDI}
RUNS = {1: CncRun.RESET, 2: CncRun.START, 3: CncRun.HOLD, 4: CncRun.START}
"""State of the interpreter: idle, reading, paused, waiting."""
AXES = "XYZABCUVW"
"""In the order of its positions and of the bits of its axis mask."""
ON = 4
"""State of the task: the machine is on; 1 and 2 are E-stop, 3 is off."""
OFF = 3
CANNOT: Mapping[str, str] = {
    Capability.SEQUENCE_NUMBER: "LinuxCNC tells the line of the file, and no N number",
    Capability.MOTOR_TEMPERATURE: "LinuxCNC does not know the spindle motor's temperature",
}
NOT_METRIC = (
    "it keeps its work offsets in another unit than mm ([TRAJ]LINEAR_UNITS), also in G21, and the guard counts in mm: "
    "nothing is written"
)


class LinuxcncCnc(LinkedCnc[BridgeLink]):
    """Implements `drivers.contract.Cnc` over LinuxCNC's status and pins."""

    wrong_answers = (BridgeError, KeyError, TypeError, ValueError)

    def __init__(self, config: CncConfig, clock: Clock) -> None:
        self._linuxcnc = config.connection_as(LinuxcncConfig)
        super().__init__(config, clock, NAME, "encrypted")
        self._pins = Pins.of(config)
        self._lacking: list[str] = []
        self._metric = False
        self._file = ""

    @property
    def cannot(self) -> Mapping[str, str]:
        found = dict(CANNOT)
        if self._lacking:
            lacking = ", ".join(self._lacking)
            found[Capability.AXIS_POSITION] = f"LinuxCNC has no axis {lacking}, or its unit is no usual one"
        if not self._metric:
            found[Capability.WRITE_MACROS] = NOT_METRIC
        return found

    async def _connect(self) -> None:
        command = self._linuxcnc.command
        text = files("drivers.linuxcnc").joinpath("bridge.py").read_text(encoding="utf-8")
        try:
            self._link = await BridgeLink.start(command, text, NAME, RUNS_AS)
        except OSError as error:
            raise FatalDriverError(
                f"cnc.linuxcnc.command: {command[0]} cannot be started ({error.strerror}): name the Python that "
                "LinuxCNC was installed for"
            ) from error
        first = await self._link.ask(nml_file=str(self._linuxcnc.nml_file), clock=self._pins.clock)
        self.identity = f"linuxcnc:{first['machine']}"

    def _program(self, path: str) -> int:
        """Return the program's number; another file under the number of the one before has once one of its own."""
        before, self._file = self._file, path
        same = before != path and program_number(before) == program_number(path)
        return number_of_path(path) if same else program_number(path)

    async def _sample(self, macros: Sequence[int]) -> CncSample:
        values, found = await self._read(macros)
        now = self._clock.now()
        task, speed = int(found["task_state"]), found["speed"]
        clock_s = float(found["clock"])
        if not math.isfinite(clock_s):
            raise BridgeError(f"its clock stands at {clock_s}")
        return CncSample(
            time=now,
            mode=MODES.get(found["task_mode"], CncMode.UNKNOWN),
            run=RUNS.get(found["interp_state"], CncRun.UNKNOWN) if task == ON else CncRun.RESET,
            alarm=task not in (ON, OFF),
            program=self._program(str(found["file"])),
            sequence_number=0,
            spindle_speed_rpm=math.nan if speed is None else float(speed),
            motor_temperature_degc=math.nan,
            clock_s=clock_s,
            power_on_count=int(found["power_on"]),
            work_offset=work_offset(int(found["offset"])),
            tool_number=int(found["tool"]),
            macros=values,
            positions_mm=self._positions_mm(found),
        )

    def _positions_mm(self, found: Mapping[str, Any]) -> dict[str, float]:
        """Return the machine position of each axis [mm]; NaN of one that the machine does not have."""
        axes, places = self._config.axis_positions, found["position"]
        inch = {1.0: False, round(1.0 / MM_PER_INCH, 6): True}.get(round(float(found["units_per_mm"]), 6))
        told = {
            name: float(places[AXES.index(axis.axis)])
            for name, axis in axes.items()
            if inch is not None and axis.axis in AXES and int(found["axes"]) >> AXES.index(axis.axis) & 1
        }
        self._lacking = [axis.axis for name, axis in axes.items() if name not in told]
        return {name: position_mm(axis, told.get(name), inch=bool(inch)) for name, axis in axes.items()}

    async def _macros(self, macros: Sequence[int]) -> dict[int, float | None]:
        return (await self._read(macros))[0]

    async def _read(self, macros: Sequence[int]) -> tuple[dict[int, float | None], dict[str, Any]]:
        pins, version = self._pins, self._config.macros.echo_guard_version
        inputs = [number for number in dict.fromkeys(macros) if number in pins.inputs]
        outputs = list(dict.fromkeys([version, *(number for number in macros if number in pins.outputs)]))
        found = await self._standing().ask(
            do="read",
            **{"in": [pins.inputs[number] for number in inputs], "out": [pins.outputs[number] for number in outputs]},
        )
        self._metric = round(float(found["units_per_mm"]), 6) == 1.0
        told = dict(zip([*inputs, *outputs], map(float, [*found["in"], *found["out"]]), strict=True))
        silent = told[version] == 0.0
        values: dict[int, float | None] = {}
        for number in macros:
            value = told.get(number)
            hidden = value is None or value == VACANT or (silent and number in pins.outputs)
            values[number] = None if hidden else value
        if wrong := next(
            (number for number, value in values.items() if value is not None and not math.isfinite(value)), 0
        ):
            raise BridgeError(f"#{wrong} is {values[wrong]}")
        return values, found

    async def _write(self, groups: Sequence[Sequence[tuple[int, float]]]) -> None:
        if not self._metric:
            raise NotSentError(f"{NAME}: {NOT_METRIC}")
        for number in (number for group in groups for number, _ in group):
            if number not in self._pins.inputs:
                raise NotSentError(
                    f"macro variable #{number} has no analog input: LinuxCNC has pins for cnc.macros only"
                )
        for group in groups:
            done = await self._standing().ask(
                do="write", values=[(self._pins.inputs[number], value) for number, value in group]
            )
            if (place := done.get("refused")) is not None:
                number, value = group[place]
                pin = f"motion.analog-in-{self._pins.inputs[number]:02d}"
                raise FatalDriverError(
                    f"the CNC refused macro variable #{number} = {value!r}: {pin}: {done['why']}; load motmod with "
                    f"num_aio={len(self._pins)} or more, and connect nothing to this pin"
                )


def program_number(path: str) -> int:
    """Return the number that a program's file has in its name, such as o1000.ngc, else one made of its path."""
    name = path.rpartition("/")[2].rpartition(".")[0] or path
    if named := re.fullmatch(r"[oO]?(\d{1,7})", name):
        return int(named[1])
    return number_of_path(path) if path else 0


def number_of_path(path: str) -> int:
    """Return a number above 9 999 999 that is made of a file's path; two paths have the same one by chance only."""
    return 10_000_000 + zlib.crc32(path.encode()) % 1_000_000_000


def work_offset(index: int) -> int:
    """Return 54 to 59 for the first six coordinate systems, 591 to 593 for G59.1 to G59.3, 0 for none."""
    return (0, 54, 55, 56, 57, 58, 59, 591, 592, 593)[index] if 0 <= index <= 9 else 0
