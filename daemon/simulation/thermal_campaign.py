"""Carries out a thermal measurement campaign on the simulated machine and writes its recordings.

The machine is the one that was tuned to the published behaviour; only the hall around it differs from
seed to seed. Every row is the mean over the minute that ends at its time. The first row of a data set
is the minute before the operation: the reference.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from config.recordings.campaign_index import INDEX_FILE, INDEX_VERSION
from config.recordings.thermal_campaign import Operation, Phase, Series, ThermalCampaign
from config.schema.temperatures import SensorConfig
from drivers.files.recording_csv import write_recording
from drivers.sim.machine.day import CHILLER_OVER_COLD_K, Day
from drivers.sim.machine.recording import record
from drivers.sim.machine.sensors import RotationJump
from drivers.sim.machine.structure import CHANNELS
from drivers.sim.nc.program import ROTATION, STANDSTILL, Block, PartProgram
from models.records import FloatArray

OVERVIEW_FILE = "overview.csv"
SAMPLES_PER_MINUTE = 6
ROTATION_JUMP = RotationJump(um={"Y1": 3.4, "Y2": 4.2})
"""Jump of the test bar when the spindle turns (chosen, just over the dissertation's threshold of 3 um)."""

Progress = Callable[[float], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Minutes:
    """One-minute means of a series."""

    names: tuple[str, ...]
    table: FloatArray
    """Columns rpm, displacements, temperatures; row 0 ends with the standstill before the first operation."""
    chiller: FloatArray


def run_thermal_campaign(
    folder: Path,
    campaign: ThermalCampaign,
    sensors: Sequence[SensorConfig],
    *,
    seed: int,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Simulate the campaign, write its recordings and index into a folder, and return the index; raises OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    index: dict[str, Any] = {
        "version": INDEX_VERSION,
        "name": campaign.name,
        "machine": "simulated",
        "seed": seed,
        "overview": OVERVIEW_FILE,
        "labels": _labels(sensors),
        "datasets": [],
    }
    overview: list[FloatArray] = []
    total = sum(len(series.operations) for series in campaign.series)
    done = 0
    room = [f"T{sensor.id}" for sensor in sensors if sensor.label == "Room"]
    for number, series in enumerate(campaign.series, start=1):
        share = len(series.operations) / total

        def within(part: float, done: int = done, share: float = share) -> None:
            if progress is not None:
                progress(done / total + share * part)

        minutes = _simulate(campaign, series, number, sensors, seed, within)
        index["datasets"] += _write_datasets(folder, campaign, series, number, minutes, seed)
        overview.append(_overview(campaign, series, minutes, room))
        done += len(series.operations)
    index["datasets"].sort(key=lambda entry: entry["dataset"])
    table = np.vstack(overview)
    columns = {name: (table[:, place], 4) for place, name in enumerate(("time_h", "rpm", "Room", "chiller", "dataset"))}
    write_recording(folder / OVERVIEW_FILE, {"campaign": campaign.name, "seed": seed}, columns)
    (folder / INDEX_FILE).write_text(json.dumps(index, indent=2) + "\n", encoding="utf-8")
    if progress is not None:
        progress(1.0)
    return index


def _labels(sensors: Sequence[SensorConfig]) -> dict[str, list[str]]:
    found: dict[str, list[str]] = {}
    for sensor in sensors:
        if sensor.label:
            found.setdefault(sensor.label, []).append(f"T{sensor.id}")
    return found


def _day(seed: int, number: int, start_day: float) -> Day:
    """Return the tuned machine in a hall of which every series sees another stretch."""
    drawn = Day.draw(seed, start="cold")
    deviations = np.random.default_rng([seed, 3, number]).uniform(-0.25, 0.25, len(drawn.start_deviation_k))
    ambient = replace(
        drawn.ambient, seed=drawn.ambient.seed + number, warmest_at_s=drawn.ambient.warmest_at_s - 86400.0 * start_day
    )
    return replace(
        Day.nominal(start="cold"),
        seed=1000 * seed + number,
        ambient=ambient,
        chiller_set_degc=ambient.mean_degc + CHILLER_OVER_COLD_K,
        start_deviation_k=dict(zip(drawn.start_deviation_k, deviations.tolist(), strict=True)),
    )


def _simulate(
    campaign: ThermalCampaign,
    series: Series,
    number: int,
    sensors: Sequence[SensorConfig],
    seed: int,
    progress: Progress,
) -> _Minutes:
    phases = [Phase(minutes=campaign.reference_minutes, speed_rpm=0.0, chiller=True)]
    for operation in series.operations:
        phases += operation.phases(campaign.minutes)
    minutes = sum(phase.minutes for phase in phases)
    header, rows = record(
        _day(seed, number, series.start_day),
        PartProgram(number=3000 + number, blocks=tuple(map(_block, phases))),
        sensors,
        hours=minutes / 60.0,
        rotation_jump=ROTATION_JUMP,
        progress=progress,
    )
    means = rows[1:, 1:].reshape(minutes, SAMPLES_PER_MINUTE, -1).mean(axis=1)
    chiller = np.repeat([float(phase.chiller) for phase in phases], [phase.minutes for phase in phases])
    first = campaign.reference_minutes - 1
    return _Minutes(names=header[1:], table=means[first:], chiller=chiller[first:])


def _block(phase: Phase) -> Block:
    turning = phase.speed_rpm > 0.0
    return Block(
        sequence_number=ROTATION if turning else STANDSTILL,
        kind="spindle" if turning else "idle",
        duration_s=60.0 * phase.minutes,
        spindle_speed_rpm=phase.speed_rpm,
        chiller=phase.chiller,
    )


def _write_datasets(
    folder: Path, campaign: ThermalCampaign, series: Series, number: int, minutes: _Minutes, seed: int
) -> list[dict[str, Any]]:
    entries = []
    for place, operation in enumerate(series.operations):
        if operation.dataset is None:
            continue
        first = place * campaign.minutes
        rows = slice(first, first + campaign.minutes + 1)
        entry = {
            "dataset": operation.dataset,
            "file": f"dataset-{operation.dataset:02}.csv",
            **_conditions(operation),
            "series": number,
            "start_h": round(24.0 * series.start_day + first / 60.0, 4),
        }
        metadata = {"campaign": campaign.name, "machine": "simulated", "seed": seed, **entry, "sample_s": 60}
        write_recording(folder / entry["file"], metadata, _columns(minutes, rows))
        entries.append(entry)
    return entries


def _conditions(operation: Operation) -> dict[str, Any]:
    return {
        "spindle_speeds_rpm": list(operation.speeds_rpm),
        "switching": operation.switching is not None,
        "previous": operation.previous,
        "cooling": operation.cooling,
        "usage": operation.usage,
    }


def _columns(minutes: _Minutes, rows: slice) -> dict[str, tuple[FloatArray, int]]:
    part = minutes.table[rows]
    columns: dict[str, tuple[FloatArray, int]] = {
        "t": (60.0 * np.arange(float(len(part))), 0),
        "rpm": (part[:, 0], 1),
        "chiller": (minutes.chiller[rows], 0),
    }
    for place, name in enumerate(minutes.names[1:], start=1):
        columns[name] = (part[:, place], 4 if place > len(CHANNELS) else 3)
    return columns


def _overview(campaign: ThermalCampaign, series: Series, minutes: _Minutes, room: Sequence[str]) -> FloatArray:
    rows = len(minutes.table)
    dataset = np.zeros(rows)
    for place, operation in enumerate(series.operations):
        dataset[place * campaign.minutes + 1 : (place + 1) * campaign.minutes + 1] = operation.dataset or 0
    places = [minutes.names.index(name) for name in room]
    room_degc = minutes.table[:, places].mean(axis=1) if places else np.full(rows, np.nan)
    hours = 24.0 * series.start_day + np.arange(rows) / 60.0
    return np.column_stack([hours, minutes.table[:, 0], room_degc, minutes.chiller, dataset])
