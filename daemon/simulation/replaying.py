"""Plays a recording over real wires while the whole daemon runs: its configuration and its result."""

import json
import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, count
from pathlib import Path
from typing import Any

import numpy as np

from config.recordings.recording_map import ColumnError, RecordingMap, load_recording_map
from config.records.commissioning import macro_map_digest
from config.schema.base import NAME_PATTERN
from config.schema.cnc import MacroMapConfig
from config.schema.temperatures import LONGEST_CHAIN, CleansingConfig
from daemon.history.reader import EventRecord
from daemon.model_release.loading import read_model
from daemon.workbench.thermal.reading import common_map
from drivers.contract import SIMULATED_CNC_IDENTITY
from drivers.sim.machine.recorded import LEAD_IN_S
from drivers.sim.nc.safe_point import GUARD_VERSION
from models.model_file import ModelError
from models.recordings.dataset import Recording
from models.recordings.findings import recording_findings
from models.recordings.plausibility import RISES_FROM_DEGC, are_rises
from models.records import OutputState
from models.thermal.family import ThermalModel, model_from_json
from models.thermal.model import MACHINE
from models.thermal.training.inputs import with_sensors
from models.thermal.training.making import sensor_ids_from_names
from models.units import TMP102_DEGC_PER_LSB

MOST_CHANNELS = 20
POSITION_AXES = "XYZUVW"
"""Axes of the simulated control that show where the recorded axes stood, in the order of the columns."""
MARGIN_MM = 1.0
"""Its axes go so much farther than the recording [mm]."""
LONGEST_CYCLE_S = 15.0
"""Recordings with longer steps are played at this period [s]: a reference is the mean of a minute, and with a cycle a
minute it may find none, so that the output would never follow."""
WHOLE_SHARE = 0.9
"""An output that is ACTIVE for less of the time played is warned of ..."""
LEAST_SHARE = 0.5
"""... and one that is for less than this did not follow: the replay ends with 1."""
LINE = "recording"
OF_THE_WIRES = (
    "no link to the CNC",
    "could not be polled",
    "has not passed its positioning",
    "echo is vacant",
    "temperatures are stale",
    "no temperature has arrived",
)
"""What keeps the output from following though the simulated wires are whole: a computer too busy for the speed."""
ON_THE_WAY = 2
"""So many cycles may have been played and not have arrived yet."""
PAUSE_S = 45.0
"""No estimate for longer than this, and than three cycles, is a pause in which the output stands still [s]; ..."""
PAUSED_SHARE = 0.05
"""... of pauses for more than this share of the time played it is told."""
OF_THE_PAST = "stand for the last"
"""In what the daemon says of a model whose lags stand for hours that it does not know."""
OF_A_SENSOR = "has changed since the reference"
OF_THE_MODEL = ("confidence", "outside the range")
FAST_MARGIN = 1.5
"""A change within a cycle may be so many times the fastest of the recording."""
MOST_CHANGE_K = 5.0
"""No temperature changes faster within a cycle [K]."""
ZERO_DEGC = 0.5 * TMP102_DEGC_PER_LSB
"""A node sends 0 degC for what is nearer to it."""
FIRST_BLOCK_S = 60.0
"""The mean over so long stands still until the work is positioned [s]."""
MOST_FINDINGS = 10
NAMED = 3
"""So many sensors are named in one sentence."""
LIMITS = {"absolute_bound_um": 200.0, "slew_um_per_min": 20.0, "step_um": 50.0, "deadband_um": 0.0}
"""Wide enough not to hide what the model does; a real machine gets its own."""


def map_of(recording: Path, map_path: Path | None) -> RecordingMap:
    """Return the given map, or the usual one, as far as the recording has its columns: the model says what is needed.

    Raises ValueError, RecordingFileError.
    """
    try:
        return common_map([recording], None if map_path is None else load_recording_map(map_path))
    except ColumnError as error:
        raise ValueError(f"{recording}: {error}") from error


def sensor_names(recording: Recording, model_file: Path) -> dict[int, str]:
    """Return the columns of the temperatures that are played, by the ID that the model gives them."""
    names = recording.temperature_names[: recording.sensors]
    model = _model(model_file)
    ids = sensor_ids_from_names(names) if model is None else model.sensor_ids[: len(names)]
    return dict(zip(ids, names, strict=True))


def _model(path: Path) -> ThermalModel | None:
    """Return a model; None for one that cannot be read, of which `modelled` says what is wrong."""
    try:
        return model_from_json(path.read_bytes(), str(path))
    except (OSError, ModelError):
        return None


def modelled(path: Path, recording: Recording) -> Recording:
    """Return the recording with what a model estimates and what it needs, in the order in which it needs that.

    Slopes along an axis [um/m] are left out: nothing measures one. Raises ValueError, saying why, for a model that
    cannot be read or was not made for these columns.
    """
    needed = _positions_that_are_there(path, recording)
    known = _model(path)
    model, inhibit = read_model(path, () if known is None else known.sensor_ids[: -len(needed) or None], (), needed)
    if model is None:
        raise ValueError(inhibit)
    if lacking := [name for name in model.sensor_names if name not in recording.temperature_names]:
        raise ValueError(
            f"{path}: the model needs the temperature {lacking[0]!r}, and the recording has "
            f"{', '.join(recording.temperature_names[: recording.sensors])}: columns go by their names, so give a "
            "recording with those that it was trained on, or name them in the map (--map)"
        )
    estimated = set(model.channels) - set(model.pivots_mm)
    channels = tuple(name for name in recording.displacement_names if name in estimated)
    if not channels:
        raise ValueError(
            f"{path}: the model estimates {', '.join(model.channels)}, and the recording has "
            f"{', '.join(recording.displacement_names)}; give a recording of a channel that it estimates"
        )
    return with_sensors(recording.with_channels(channels), model.sensor_names)


def _positions_that_are_there(path: Path, recording: Recording) -> tuple[str, ...]:
    """Return the axis positions that a model needs; raises ValueError where the recording cannot play one."""
    model = _model(path)
    needed = () if model is None else model.axis_positions
    if lacking := [name for name in needed if name not in recording.axis_positions]:
        raise ValueError(
            f"{path}: the model needs the axis position {lacking[0]}, and the recording has "
            f"{', '.join(recording.axis_positions) or 'none'}: name its column under axis_positions in the map (--map)"
        )
    if len(needed) > len(POSITION_AXES):
        raise ValueError(f"a replay plays at most {len(POSITION_AXES)} axis positions, the model needs {len(needed)}")
    if strange := [name for name in needed if re.fullmatch(NAME_PATTERN, name) is None]:
        raise ValueError(
            f"{path}: no key of cnc.axis_positions may be called {strange[0]!r}: give the column a name of letters, "
            "digits and _, and train the model again"
        )
    return needed


def position_axes(names: Sequence[str]) -> dict[str, str]:
    """Return the axis of the simulated control that shows each position."""
    return dict(zip(names, POSITION_AXES, strict=False))


def played_positions(recording: Recording) -> dict[str, dict[str, Any]]:
    """Return as which axis each position of a recording is played, and for which share of its rows it is known."""
    known = np.isfinite(recording.temperatures_degc[:, recording.sensors :]).mean(axis=0).tolist()
    axes = position_axes(recording.axis_positions).items()
    return {name: {"axis": axis, "known": share} for (name, axis), share in zip(axes, known, strict=True)}


def _axis_positions(recording: Recording) -> dict[str, dict[str, Any]]:
    """Return the section of the positions: no recording tells how fast an axis is, so that none of them is a slip."""
    found = {}
    for place, (name, letter) in enumerate(position_axes(recording.axis_positions).items(), start=1):
        mm = recording.temperatures_degc[:, recording.sensors + place - 1]
        known = mm[np.isfinite(mm)] if np.isfinite(mm).any() else np.zeros(1)
        travel_mm = [float(known.min()) - MARGIN_MM, float(known.max()) + MARGIN_MM]
        fastest = 60.0 * (travel_mm[1] - travel_mm[0])
        found[name] = {"axis": letter, "number": place, "travel_mm": travel_mm, "rapid_mm_per_min": fastest}
    return found


def playing_time_s(recording: Recording) -> float:
    """Return how long the simulated machine plays it, the lead-in included [s]."""
    return LEAD_IN_S + float(recording.time_s[-1] - recording.time_s[0])


def played_utc_s(recording: Recording, began_utc_s: float) -> tuple[float, float]:
    """Return from when to when it is played on the machine's clock, without the lead-in [s]."""
    return began_utc_s + LEAD_IN_S, began_utc_s + playing_time_s(recording)


@dataclass(frozen=True, slots=True, kw_only=True)
class Following:
    """How much of a replay the output followed the estimate."""

    active_share: float
    """Share of the played time in ACTIVE, 0..1."""
    states: dict[str, float]
    """Share of each state."""
    why: str
    """Why it was anything else for longest, '' when it never was."""

    @property
    def warning(self) -> str:
        """Return what is said where the output did not follow all the time, '' where it did."""
        if self.active_share >= WHOLE_SHARE:
            return ""
        cause = f", mostly because: {self.why}" if self.why else ""
        return (
            f"the output followed the estimate (ACTIVE) for {self.active_share:.0%} of the time played{cause}; the "
            "figures with compensation are of a loop that stood still in between"
        )

    def advice(self, speed: float) -> str:
        """Return what to do where the output did not follow all the time, '' where nothing is known to help.

        `speed`: at which it was played [simulated s per s].
        """
        if not self.warning:
            return ""
        if any(words in self.why for words in OF_THE_WIRES):
            return (
                f"nothing in the recording does that: this computer is too busy to play it at --speed {speed:g}; "
                f"play it again at --speed {max(speed / 4.0, 1.0):g}"
            )
        if OF_A_SENSOR not in self.why and any(words in self.why for words in OF_THE_MODEL):
            return (
                "what was played goes where training did not, or begins without its past: record 2 runs like it and "
                "train on them too, or begin some hours earlier (--from-hours)"
            )
        if "sensor " in self.why:
            return "look at that sensor in the recording, and leave its fields empty where it is wrong"
        return ""


def pauses(estimated_s: Sequence[float], cycle_s: float, speed: float) -> str:
    """Return what is said where estimates came late, because the computer is too busy for the speed; else ''.

    `estimated_s`: when there was an estimate [s]; `cycle_s`: time between two cycles of temperatures [s].
    """
    apart_s = np.diff(np.unique(np.asarray(estimated_s, dtype=np.float64)))
    late_s = apart_s[apart_s > max(PAUSE_S, 3.0 * cycle_s)]
    if not len(late_s) or (share := float(late_s.sum() / apart_s.sum())) <= PAUSED_SHARE:
        return ""
    return (
        f"this computer was too busy for --speed {speed:g}: for {share:.0%} of the time played no estimate came for "
        f"{PAUSE_S:g} s or longer, at most {late_s.max():.0f} s, in which the output stood still, and the figures with "
        f"compensation are worse than a machine's; play it again at --speed {max(speed / 4.0, 1.0):g}"
    )


def not_enabled(refusal: str, arrived: int, played: float) -> str:
    """Return why a replay could not be switched on, with what to do about it in a replay.

    `arrived`: so many cycles of temperatures did; `played`: of so many.
    """
    if OF_THE_PAST not in refusal:
        return refusal
    if arrived < WHOLE_SHARE * played - ON_THE_WAY:
        return (
            f"the daemon refused to enable: of {played:.0f} cycles of temperatures {arrived or 'none'} arrived, so too "
            "little is known of the past; nothing in the recording does that: this computer is too busy, play it "
            "again at a smaller --speed"
        )
    return (
        f"{refusal.partition('; wait')[0]}: begin the replay where the machine has stood still for hours "
        "(--from-hours), or join what was recorded before to the file; what begins warm can be played with a model "
        "without lags alone (`toolpoint thermal train --model ridge`)"
    )


def following(
    events: Sequence[EventRecord], from_utc_s: float, to_utc_s: float, names: Mapping[int, str] | None = None
) -> Following:
    """Return for how much of a span of time the output was in each state, from the history's changes of state.

    `names`: columns of the recording's temperatures by sensor, which are said beside `sensor 1` and so on.
    """
    state, why, at_s = OutputState.OFF.value, "it was not switched on", from_utc_s
    spent_s: defaultdict[str, float] = defaultdict(float)
    reasons_s: defaultdict[str, float] = defaultdict(float)

    def until(time_s: float) -> None:
        lasted_s = max(min(time_s, to_utc_s) - at_s, 0.0)
        spent_s[state] += lasted_s
        if state != OutputState.ACTIVE.value:
            reasons_s[why] += lasted_s

    for event in events:
        change = re.fullmatch(r"(\w+) -> (\w+): (.*)", event.text, re.DOTALL)
        if event.kind != "state" or change is None:
            continue
        if event.time_s > at_s:
            until(event.time_s)
            at_s = min(event.time_s, to_utc_s)
        ends = change[2] == OutputState.OFF.value and state != OutputState.OFF.value
        state, why = change[2], why if ends and why else change[3]  # why it went back counts, not that it arrived
    until(to_utc_s)
    whole_s = max(to_utc_s - from_utc_s, 1e-9)
    states = {name: seconds / whole_s for name, seconds in spent_s.items() if seconds > 0.0}
    longest = max(reasons_s, key=lambda reason: reasons_s[reason]) if sum(reasons_s.values()) > 0.0 else ""
    why = re.sub(r"\bsensor (\d+)", lambda found: _named(found, names or {}), longest)
    return Following(active_share=states.get(OutputState.ACTIVE.value, 0.0), states=states, why=why)


def _named(sensor: "re.Match[str]", names: Mapping[int, str]) -> str:
    """Return `sensor 6 (T6)`; as it is where the recording has no such column."""
    name = names.get(int(sensor[1]))
    return sensor[0] if name is None else f"{sensor[0]} ({name})"


def replay_machine(recording: Recording, model_file: Path, record_file: Path) -> dict[str, Any]:
    """Return a machine description for one recording: one line, a channel and an axis per displacement."""
    channels = recording.displacement_names
    if len(channels) > MOST_CHANNELS:
        raise ValueError(
            f"a replay takes at most {MOST_CHANNELS} displacement channels, the recording has {len(channels)}"
        )
    axes, names, model = axis_names(channels), sensor_names(recording, model_file), _model(model_file)
    trained_on = "" if model is None else str(model.hyper_parameters.get(MACHINE, ""))
    period_s = float(np.median(np.diff(recording.time_s)))
    mean_s = FIRST_BLOCK_S if model is None or model.period_s is None else model.period_s  # more lags behind
    cycle_s = min(period_s, LONGEST_CYCLE_S)
    sensors = [{"id": number, "component": "recording", "part": name} for number, name in names.items()]
    macros = _macro_map(tuple(axes))
    record_file.write_text(json.dumps(_commissioning(macros)), encoding="utf-8")
    return {
        "machine": trained_on or f"recording {recording.name}",
        "temperatures": {
            "lines": [
                {
                    "name": name,
                    "port": "",
                    "baud": 115200,
                    "cycle_period_s": cycle_s,
                    "chain": [f"{part[0]}-{part[-1]}"] if part == list(range(part[0], part[-1] + 1)) else part,
                }
                for name, part in _lines(list(names)).items()
            ],
            "sensors": sensors,
            "cleansing": {
                "stale_after_s": max(300.0, 5 * period_s),
                "max_change_degc": allowed_change_k(recording, cycle_s)[0],
            },
        },
        "displacements": {
            "file": {"path": ""},
            "channels": [{"name": channel, "column": axis} for axis, channel in axes.items()],
        },
        "cnc": {"macros": macros, "guard": guard_of(tuple(axes)), "axis_positions": _axis_positions(recording)},
        "compensation": {
            "model_file": str(model_file.resolve()),
            "commissioning_file": str(record_file),
            "axes": {axis: {"estimate": channel, **LIMITS} for axis, channel in axes.items()},
            "reference": {"sequence_numbers": [100], "mean_s": mean_s},
            "output": {"safe_sequence_numbers": [900]},
        },
    }


def allowed_change_k(recording: Recording, cycle_s: float) -> tuple[float, str]:
    """Return the change within a cycle that the machine must allow [K], and what is said where that is not the default.

    A healthy sensor beside a motor may move by several kelvin a minute: what a cycle of `cycle_s` [s] sees of it must
    not count as another level of the sensor. What goes on in the next row is no spike and no step.
    """
    usual_k = CleansingConfig().max_change_degc
    degc = recording.without_impossible().temperatures_degc[:, : recording.sensors]
    per_cycle = np.diff(degc, axis=0) * np.minimum(cycle_s / np.diff(recording.time_s), 1.0)[:, None]
    before, after = np.nan_to_num(per_cycle[:-1]), np.nan_to_num(per_cycle[1:])
    lasting = np.where(before * after > 0.0, np.minimum(np.abs(before), np.abs(after)), 0.0)
    fastest_k = np.minimum(lasting.max(axis=0, initial=0.0), MOST_CHANGE_K)
    quick = [number for number in np.argsort(-fastest_k)[:NAMED].tolist() if FAST_MARGIN * fastest_k[number] > usual_k]
    if not quick:
        return usual_k, ""
    needed_k = float(np.ceil(10.0 * FAST_MARGIN * fastest_k[quick[0]]) / 10.0)
    named = ", ".join(f"{recording.temperature_names[i]} by {fastest_k[i]:.1f} K" for i in quick)
    return needed_k, (
        f"within a cycle of {cycle_s:g} s temperatures change faster than a machine allows by default ({named}); this "
        f"is played with temperatures.cleansing.max_change_degc: {needed_k:g}, and the machine needs that too, or the "
        "output holds because a sensor seems to be at another level"
    )


def findings_said(recording: Recording) -> list[str]:
    """Return what training would say of a recording: values that cannot be, a displacement that jumps, gaps."""
    found = recording_findings(recording, len(recording.temperature_names) + 1)
    return [f"{recording.name}: {finding}" for finding in found[:MOST_FINDINGS]]


def played_otherwise(whole: Recording, part: Recording) -> list[str]:
    """Return what is said of temperatures near 0 degC, where a node that was reset sends the same.

    `whole`: the recording, whose beginning tells rises since the start from temperatures. `part`: what is played of it.
    """
    if are_rises(whole.temperatures_degc[:, : whole.sensors]):
        start = f"{RISES_FROM_DEGC:g} degC"
        return [f"all temperatures begin at 0, so they are taken for rises since the start, and played from {start} on"]
    first_degc = part.downsampled(FIRST_BLOCK_S).temperatures_degc[0, : part.sensors]
    names = [name for name, degc in zip(part.temperature_names, first_degc, strict=False) if abs(degc) < ZERO_DEGC]
    if not names:
        return []
    listed = ", ".join(names[:NAMED]) + (f" and {len(names) - NAMED} more" if len(names) > NAMED else "")
    return [
        f"what is played begins at 0 degC ({listed}): a node that was reset sends the same, so such a sensor counts as "
        "missing until it sends something else, and where too few are left the replay cannot be switched on; begin "
        "where they are warmer (--from-hours). Rises since the start are known by all temperatures beginning at 0: "
        "play the file from its first row"
    ]


def _lines(sensor_ids: Sequence[int]) -> dict[str, list[int]]:
    """Return the sensors of each line, as few lines as can carry them."""
    lines = -(-len(sensor_ids) // LONGEST_CHAIN)
    parts = np.array_split(np.array(sensor_ids), lines)
    return {LINE if n == 1 else f"{LINE}_{n}": part.tolist() for n, part in enumerate(parts, start=1)}


def axis_names(channels: Sequence[str]) -> dict[str, str]:
    """Return the axis that stands for each channel: the channel's name as far as a name may be written so."""
    found: dict[str, str] = {}
    for channel in channels:
        letters = re.sub(r"[^A-Za-z0-9]+", "_", channel).strip("_")[:30]
        wanted = letters if letters[:1].isalpha() and letters[:1].isascii() else f"c{letters}"
        name = next(name for name in chain([wanted], (f"{wanted}_{n}" for n in count(2))) if name not in found)
        found[name] = channel
    return found


def _macro_map(channels: tuple[str, ...]) -> dict[str, Any]:
    values = {name: 510 + index for index, name in enumerate(channels)}
    return {
        "writable": ["120", "500-540"],
        "sequence_a": 500,
        "values": values,
        "valid_until": 120,
        "enable": 501,
        "sequence_b": 502,
        "check": 503,
        "echo_applied": {name: 550 + index for index, name in enumerate(channels)},
        "echo_time": 580,
        "echo_status": 581,
        "echo_guard_version": 582,
        "request": {"counter": 530, "kind": 531, "axis": 532, "value_mm": 533, "acknowledge": 534},
    }


def guard_of(channels: tuple[str, ...]) -> dict[str, Any]:
    """Return the settings of a control that has an axis for every channel."""
    axes = {
        name: {"letter": letter, "number": number, "linear": True}
        for number, (name, letter) in enumerate(zip(channels, "XYZUVWABC", strict=False), start=1)
    }
    return {"increment_mm": 0.0001, "on_timeout": "continue", "axes": axes}


def _commissioning(macros: dict[str, Any]) -> dict[str, Any]:
    """Return the record of the simulated control, whose sign is known by construction."""
    axis = {"sign": 1, "scale": 1.0, "written_um": 10.0, "measured_um": 10.0}
    return {
        "cnc_identity": SIMULATED_CNC_IDENTITY,
        "macro_map_sha256": macro_map_digest(MacroMapConfig.model_validate(macros)),
        "guard_version": GUARD_VERSION,
        "person": "replay of a recording on the simulated control",
        "date": "2026-01-01",
        "axes": dict.fromkeys(macros["values"], axis),
    }
