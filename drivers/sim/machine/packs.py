"""One sensor of a simulated machine, moved between a hot pack and an ice pack by a script.

It follows its pack with a first-order lag, converts with noise and rounds as the others do. What really happened
(moves, register reads, writes of one macro variable) is reported in the machine's time, and in wall time where bytes or
macros pass.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from drivers.clock import Clock
from drivers.sim.contract import AxisTruth, Macros, SimulatedMachine, SimulatedNc
from drivers.sim.machine.sensors import NOISE_PERIOD_S, TMP102_NOISE_K
from models.units import TMP102_DEGC_PER_LSB

Report = Callable[[dict[str, Any]], None]


class PackScriptError(ValueError):
    """A script that cannot be played; the text names the file, the key and what is allowed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PackScript:
    """When one sensor is moved, between what, and which macro variable is watched."""

    sensor: int
    """ID of a TMP102."""
    ice_degc: float
    hot_degc: float
    lag_s: float
    """Time constant of the sensor on its pack [s]."""
    change_degc: float
    """A reading that differs by this from what it was at the move shows the move [degC]."""
    moves_s: tuple[float, ...]
    """When the sensor is moved to the other pack; it begins on ice [s of the clock of the lines]."""
    macro: int
    """The macro variable whose writes are reported."""


def load_pack_script(path: Path) -> PackScript:
    """Read a script (YAML); raises PackScriptError."""
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise PackScriptError(f"{path}: cannot be read: {error}") from error
    wanted = {field.name for field in fields(PackScript)}
    if not isinstance(content, dict) or set(content) != wanted:
        raise PackScriptError(f"{path}: a script has exactly the keys {', '.join(sorted(wanted))}")
    moves_s = content.pop("moves_s")
    numbers = [*content.values(), *(moves_s if isinstance(moves_s, list) else [None])]
    if not all(isinstance(number, int | float) and math.isfinite(number) for number in numbers):
        raise PackScriptError(f"{path}: every value must be a finite number, moves_s a list of them")
    script = PackScript(moves_s=tuple(float(time_s) for time_s in moves_s), **content)
    if any(later <= earlier for earlier, later in itertools.pairwise(script.moves_s)):
        raise PackScriptError(f"{path}: moves_s must increase")
    if not (script.lag_s > 0 and script.change_degc > 0):
        raise PackScriptError(f"{path}: lag_s and change_degc must be positive")
    return script


class SensorOnPacks:
    """The temperature of the moved sensor over time, in closed form."""

    def __init__(self, script: PackScript) -> None:
        self._script = script
        self._stretches: list[tuple[float, float, float]] = [(-math.inf, script.ice_degc, script.ice_degc)]
        for number, move_s in enumerate(script.moves_s, start=1):
            target = script.hot_degc if number % 2 else script.ice_degc
            self._stretches.append((move_s, self.degc(move_s), target))

    def degc(self, time_s: float) -> float:
        """Return the sensor's own temperature, without noise [degC]."""
        since_s, begun, target = next(stretch for stretch in reversed(self._stretches) if stretch[0] <= time_s)
        if math.isinf(since_s):
            return target
        return target + (begun - target) * math.exp(-(time_s - since_s) / self._script.lag_s)

    def lag_s(self, number: int) -> float:
        """Return how long after move `number` (from 1) the temperature has changed by `change_degc` [s]."""
        _, begun, target = self._stretches[number]
        whole = abs(target - begun)
        if whole <= self._script.change_degc:
            return math.inf
        return -self._script.lag_s * math.log1p(-self._script.change_degc / whole)


class _WatchedMacros:
    """The NC's macro variables; writes of one of them are told."""

    def __init__(self, macros: Macros, number: int, tell: Callable[[float | None], None]) -> None:
        self._macros, self._number, self._tell = macros, number, tell

    def get(self, number: int) -> float | None:
        """Return the variable, None where it is vacant."""
        return self._macros.get(number)

    def set(self, number: int, value: float | None) -> None:
        self._macros.set(number, value)
        if number == self._number:
            self._tell(value)


class PackedMachine:
    """A simulated machine with one sensor on packs; implements `drivers.sim.contract.SimulatedMachine`."""

    def __init__(self, machine: SimulatedMachine, script: PackScript, line: str, clock: Clock, report: Report) -> None:
        """Wrap `machine`; `line` is the one that the sensor hangs on."""
        self._machine = machine
        self._script = script
        self._line = line
        self._clock = clock
        self._report = report
        self._sensor = SensorOnPacks(script)
        self._origin_s = 0.0
        self._moved = 0
        self._reading_degc: float | None = None
        machine.nc.macros = _WatchedMacros(machine.nc.macros, script.macro, self._macro_set)

    @property
    def time_s(self) -> float:
        """Simulated seconds since the machine's start."""
        return self._machine.time_s

    @property
    def nc(self) -> SimulatedNc:
        return self._machine.nc

    def began(self, origin_s: float) -> None:
        """Take the clock's time at which the machine's time was 0 [s]."""
        self._origin_s = origin_s

    def advance(self, to_s: float) -> None:
        """Move on, and report the moves of the sensor that have come."""
        self._machine.advance(to_s)
        for number, move_s in enumerate(self._script.moves_s[self._moved :], start=self._moved + 1):
            if move_s > self._origin_s + self._machine.time_s:
                break
            self._moved = number
            self._report(
                {
                    "move": {
                        "number": number,
                        "time_s": move_s,
                        "hot": number % 2 == 1,
                        "lag_s": self._sensor.lag_s(number),
                    }
                }
            )

    def register_codes(self, sensor_ids: Sequence[int]) -> list[int]:
        """Return the registers' contents now, the moved sensor's from its pack."""
        codes = self._machine.register_codes(sensor_ids)
        if self._script.sensor in sensor_ids:
            time_s = self._origin_s + self._machine.time_s
            noise = np.random.default_rng([self._script.sensor, 7, int(max(time_s, 0.0) // NOISE_PERIOD_S)])
            degc = self._sensor.degc(time_s) + TMP102_NOISE_K * noise.standard_normal()
            steps = round(degc / TMP102_DEGC_PER_LSB)
            self._reading_degc = steps * TMP102_DEGC_PER_LSB
            codes[list(sensor_ids).index(self._script.sensor)] = steps & 0xFFF
        return codes

    def passed(self, line: str, start_s: float, end_s: float) -> None:
        """Report a pass over a line whose last byte leaves now, with the moved sensor's reading if it is its line."""
        self._report(
            {
                "pass": {
                    "line": line,
                    "start_s": self._origin_s + start_s,
                    "end_s": self._origin_s + end_s,
                    "degc": self._reading_degc if line == self._line else None,
                    "real_s": self._clock.now().real_s,
                }
            }
        )

    def _macro_set(self, value: float | None) -> None:
        now = self._clock.now()
        self._report({"macro": {"value": value, "time_s": now.monotonic_s, "real_s": now.real_s}})

    def displacement_um(self) -> dict[str, float]:
        """Return the displacement sensors' readings by channel [um]."""
        return self._machine.displacement_um()

    def truth(self) -> dict[str, AxisTruth]:
        """Return the tool point's true error per axis."""
        return self._machine.truth()
