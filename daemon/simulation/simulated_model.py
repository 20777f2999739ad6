"""Fits the model that ships for the simulated machine: `python -m daemon.simulation.simulated_model`.

It is trained like any other model, on recordings: of simulated days whose parameters differ from
each other, from those of the days it is judged on and from the demo's, and of test programmes, not
of the part programme of the demo. Interval and penalty are chosen by leaving whole days out.
"""

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import click
import numpy as np

from config.loader import load_configuration
from config.machines import shipped_file
from config.schema.temperatures import SensorConfig
from daemon.simulation.simulation import DEMO_SEED
from daemon.workbench.thermal.training import write_model_file
from drivers.sim.machine.day import Day
from drivers.sim.machine.recording import record
from drivers.sim.machine.travel import SHARES, STAY_S, AxisTravel
from drivers.sim.nc.program import (
    PartProgram,
    alternating_program,
    demo_program,
    rotation_program,
    stepwise_program,
    switching_program,
)
from models.recordings.dataset import Recording
from models.recordings.slopes import SLOPE_SUFFIX, offset_and_slope
from models.thermal.estimation import Machine, OnlineReference
from models.thermal.family import ThermalModel
from models.thermal.training.evaluation import ResidualMetrics, residual_metrics
from models.thermal.training.increment_family import IncrementChoices
from models.thermal.training.recipes import increment_recipe
from models.thermal.training.train_family import FamilyTraining, train_family

CHANNELS = ("Y1", "Y2", "Z1", "Z2", "Z3")
"""X stays below 5 um and is not modelled."""
TRAINING_SEEDS = tuple(range(1, 17))
UNSEEN_SEEDS = tuple(range(101, 109))
"""Days for the final judgement; nothing is chosen on them."""
INTERVALS_MIN = (1.0, 5.0, 10.0, 20.0, 30.0, 60.0)
HOURS = 10.0
UNSEEN_HOURS = 6.0
PASS_S = STAY_S * len(SHARES)
"""An axis comes to all its places and back in this time [s]."""
MODEL_NAME = "simulated_machine_model.json"

assert DEMO_SEED not in {*TRAINING_SEEDS, *UNSEEN_SEEDS}


def published_sensors() -> list[SensorConfig]:
    return load_configuration(shipped_file("cfrpmt.yaml")).temperatures.sensors


def training_programmes() -> tuple[PartProgram, ...]:
    """Return the programmes of the training days, used in turn: the kinds of test that the dissertation made."""
    return (
        rotation_program(speed_rpm=12000.0),
        stepwise_program((3000.0, 6000.0, 9000.0, 12000.0), minutes_each=40.0, idle_reduction=True),
        alternating_program((12000.0, 8000.0), idle_reduction=(False, True)),
        switching_program(),
        rotation_program(speed_rpm=9000.0, hours=4.0, idle_reduction=True),
        stepwise_program((12000.0, 4000.0, 10000.0, 7000.0), minutes_each=60.0),
        alternating_program((10000.0, 12000.0), hours=1.0, idle_hours=2.0, idle_reduction=(True,)),
        switching_program(speed_rpm=10000.0, rotation_min=(20, 40), idle_min=(10, 30)),
    )


def simulated_recording(
    seed: int,
    program: PartProgram,
    sensors: Sequence[SensorConfig],
    *,
    hours: float,
    travels: Mapping[str, AxisTravel] | None = None,
    slopes: Mapping[str, float] | None = None,
) -> Recording:
    """Return what loggers would have written on one simulated day.

    `travels`: of the axes that go along the work. `slopes`: displacements that become an offset and a slope along their
    axis, with its pivot [mm]; others along that axis are left out.
    """
    header, rows = record(Day.draw(seed), program, sensors, hours=hours, travels=travels)
    column = {name: index for index, name in enumerate(header)}
    time_s = rows[:, column["t"]].copy()
    along = {channel[0] for channel in slopes or {}}
    um = {name: rows[:, column[name]] for name in CHANNELS if name in (slopes or {}) or name[0] not in along}
    pivots_mm = {}
    for channel, pivot_mm in (slopes or {}).items():
        position_mm, name = rows[:, column[f"{channel[0]}_mm"]], channel + SLOPE_SUFFIX
        um[channel], um[name] = offset_and_slope(time_s, position_mm, um[channel], pivot_mm=pivot_mm, pass_s=PASS_S)
        pivots_mm[name] = pivot_mm
    names = tuple(f"T{sensor.id}" for sensor in sensors)
    return Recording(
        name=f"simulated day {seed}, O{program.number}",
        time_s=time_s,
        speed_rpm=rows[:, column["rpm"]].copy(),
        temperature_names=names,
        temperatures_degc=rows[:, [column[name] for name in names]],
        displacement_names=tuple(um),
        displacements_um=np.column_stack(list(um.values())),
        pivots_mm=pivots_mm,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Fitted:
    """The best candidate, and the held-out score of every one."""

    result: FamilyTraining
    scores: dict[float, float]
    """Mean held-out RMSE with / without the model, by interval [min]."""


def fit_best(recordings: Sequence[Recording], progress: Callable[[int, int], None]) -> Fitted:
    """Train one ridge model per interval and keep the one that predicts left-out days best."""
    created = datetime.now(UTC).isoformat(timespec="seconds")
    results: dict[float, FamilyTraining] = {}
    for number, interval_min in enumerate(INTERVALS_MIN, start=1):
        choices = IncrementChoices(interval_min=interval_min, ridge_k2="auto", split_at_speed_changes=False)
        results[interval_min] = train_family(recordings, increment_recipe(choices), sample_s=60.0, created=created)
        progress(number, len(INTERVALS_MIN))
    best = min(results.values(), key=_score)
    return Fitted(result=best, scores={interval: _score(result) for interval, result in results.items()})


def _score(result: FamilyTraining) -> float:
    return result.trust.held_out_relative_rmse


@dataclass(frozen=True, slots=True, kw_only=True)
class Judgement:
    """How the model does on one day that nothing was fitted or chosen on."""

    day: str
    metrics: ResidualMetrics
    in_domain_share: float
    """Share of the minutes that lie within the range that training covered."""


def judge(model: ThermalModel, recording: Recording, sensors: Sequence[SensorConfig]) -> Judgement:
    """Run the model over a day as the daemon does, with one reference at its start."""
    minutes = recording.downsampled(60.0)
    online = model.runtime(Machine(components={sensor.id: sensor.component for sensor in sensors}))
    time_min = (minutes.time_s - minutes.time_s[0]) / 60.0
    first_degc = minutes.temperatures_degc[0]
    online.set_reference(OnlineReference(time_min=0.0, now_min=0.0, degc=first_degc))
    nobody = np.zeros(len(first_degc), dtype=np.bool_)
    estimated, in_domain = [], []
    for now_min, degc in zip(time_min.tolist(), minutes.temperatures_degc, strict=True):
        online.on_sample(now_min, degc, float("nan"))
        outcome, _ = online.estimate(now_min, degc, nobody)
        assert outcome is not None
        estimated.append(outcome.thermal_error_um)
        in_domain.append(outcome.in_domain)
    return Judgement(
        day=recording.name,
        metrics=residual_metrics(model.channels, minutes.displacements_um, np.array(estimated)),
        in_domain_share=float(np.mean(in_domain)),
    )


def unseen_days(sensors: Sequence[SensorConfig]) -> list[Recording]:
    """Return days that nothing was fitted or chosen on, half of them with the demo's part programme."""
    programmes = (demo_program(), *training_programmes()[:3])
    return [
        simulated_recording(seed, programmes[0 if index % 2 else index // 2 % 3 + 1], sensors, hours=UNSEEN_HOURS)
        for index, seed in enumerate(UNSEEN_SEEDS)
    ]


@click.command()
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path, dir_okay=False),
    default=lambda: shipped_file("cfrpmt.yaml").with_name(MODEL_NAME),
    help="The model's file; without it the one that ships is replaced.",
)
def main(output: Path) -> None:
    """Fit the model of the simulated machine and judge it on days it has not seen."""
    sensors = published_sensors()
    programmes = training_programmes()
    recordings = []
    with click.progressbar(TRAINING_SEEDS, label="recording days", file=sys.stderr) as seeds:
        for seed in seeds:
            program = programmes[(seed - 1) % len(programmes)]
            recordings.append(simulated_recording(seed, program, sensors, hours=HOURS))
    fitted = fit_best(recordings, lambda done, total: click.echo(f"interval {done} of {total} is fitted", err=True))
    for interval_min, score in fitted.scores.items():
        click.echo(f"interval {interval_min:4g} min: {score:.3f} of the error remains on left-out days")
    model = fitted.result.model
    write_model_file(model, output)
    click.echo(f"{output}: {model.model_id}, {output.stat().st_size} bytes")
    for judgement in (judge(model, day, sensors) for day in unseen_days(sensors)):
        click.echo(f"{judgement.day}: {judgement.in_domain_share:.0%} in domain; rmse and max [um] without -> with")
        metrics = judgement.metrics
        for index, channel in enumerate(metrics.channels):
            click.echo(
                f"  {channel}: {metrics.rmse_without_um[index]:6.2f} -> {metrics.rmse_with_um[index]:5.2f}"
                f"   {metrics.max_without_um[index]:6.2f} -> {metrics.max_with_um[index]:5.2f}"
            )


if __name__ == "__main__":
    main()
