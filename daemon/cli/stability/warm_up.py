"""`toolpoint stability warm-up`."""

from pathlib import Path

import click

from daemon.cli.common import FiniteFloat, json_option, picture_option, refuse, write_json

POSITIVE = FiniteFloat(min=0.0, min_open=True)
PERCENT = FiniteFloat(min=0.0, max=40.0)


@click.command("warm-up")
@click.argument("case_path", metavar="CASE.yaml", type=click.Path(path_type=Path))
@click.option("--programmed-rpm", type=POSITIVE, required=True, help="Programmed spindle speed [1/min].")
@click.option("--depth-mm", type=POSITIVE, required=True, help="Programmed axial depth of cut [mm].")
@click.option("--minutes", type=click.IntRange(5, 600), default=60, show_default=True, help="Time of milling [min].")
@click.option(
    "--feed-per-tooth-mm", type=POSITIVE, default=0.05, show_default=True, help="Programmed feed per tooth [mm]."
)
@click.option(
    "--min-rpm", type=POSITIVE, default=1000.0, show_default=True, help="Lowest speed of the machine [1/min]."
)
@click.option(
    "--max-rpm",
    type=FiniteFloat(min=0.0, min_open=True, max=12000.0),
    default=12000.0,
    show_default=True,
    help="Highest speed; the simulated machine's own is 12000 [1/min].",
)
@click.option(
    "--max-change-percent", type=POSITIVE, default=20.0, show_default=True, help="Greatest change of the speed [%]."
)
@click.option(
    "--margin-percent",
    type=PERCENT,
    default=20.0,
    show_default=True,
    help="The limiting depth exceeds the programmed one by this much [%].",
)
@click.option(
    "--tolerance-percent",
    type=PERCENT,
    default=2.0,
    show_default=True,
    help="It does so this far to both sides of the speed [%].",
)
@click.option(
    "--offset-hz",
    type=FiniteFloat(),
    default=20.0,
    show_default=True,
    help="The published rule keeps the tooth-passing frequency this far below the resonance [Hz].",
)
@click.option(
    "--rule-axis", type=click.Choice(["x", "y"]), help="Axis that the rule follows. Without: the softer at resonance."
)
@click.option(
    "--method",
    type=click.Choice(["zoa", "sdm"]),
    default="zoa",
    show_default=True,
    help="Lobes that the tuning uses: zeroth-order solution, or semi-discretisation.",
)
@click.option(
    "--verify-with-sdm/--no-verify-with-sdm",
    default=True,
    show_default=True,
    help="Verify a chosen speed by semi-discretisation (SDM) too.",
)
@click.option(
    "--dynamics",
    type=click.Choice(["spindle", "case"]),
    default="spindle",
    show_default=True,
    help="spindle: finite elements of the simulated machine with its end mill of 10 or 16 mm; case: the CASE's modes.",
)
@click.option("--machine", "machine_seed", type=click.IntRange(0), default=1, show_default=True, help="Which machine.")
@click.option("--day", "day_seed", type=click.IntRange(0), default=1, show_default=True, help="Which day.")
@picture_option
@json_option
def warm_up(
    case_path: Path,
    programmed_rpm: float,
    depth_mm: float,
    minutes: int,
    feed_per_tooth_mm: float,
    min_rpm: float,
    max_rpm: float,
    max_change_percent: float,
    margin_percent: float,
    tolerance_percent: float,
    offset_hz: float,
    rule_axis: str | None,
    method: str,
    verify_with_sdm: bool,
    dynamics: str,
    machine_seed: int,
    day_seed: int,
    picture: Path | None,
    json_path: str | None,
) -> None:
    """Let the simulated machine mill the CASE while it warms: untuned, by the published rule, and tuned.

    The CASE gives tool, engagement and material. The tool point is that of the simulated machine's finite elements,
    whose bearings change with temperature, or with --dynamics case one with the CASE's modes when cold. What the tuning
    knows was fitted on impact tests of other days.
    """
    from config.machine.stability_case import load_stability_case
    from daemon.simulation.warm_up.report import in_words, warm_up_content, warm_up_picture
    from daemon.simulation.warm_up.run import WarmUpRequest
    from daemon.simulation.warm_up.run import warm_up as milled
    from models.errors import StabilityError
    from models.spindle_speed.choice import SpeedDemand, SpeedLimits
    from models.spindle_speed.tuning import SpeedTuningError

    request = WarmUpRequest(
        demand=SpeedDemand(
            programmed_rpm=programmed_rpm,
            depth_mm=depth_mm,
            margin_fraction=margin_percent / 100.0,
            tolerance_fraction=tolerance_percent / 100.0,
        ),
        limits=SpeedLimits(
            machine_lowest_rpm=min_rpm, machine_highest_rpm=max_rpm, within_fraction=max_change_percent / 100.0
        ),
        minutes=minutes,
        feed_per_tooth_mm=feed_per_tooth_mm,
        method=method,
        verify_with_sdm=verify_with_sdm,
        dynamics=dynamics,
        rule_axis=rule_axis,
        offset_hz=offset_hz,
        machine_seed=machine_seed,
        day_seed=day_seed,
    )
    try:
        runs = milled(load_stability_case(case_path), request)
    except (StabilityError, SpeedTuningError) as error:
        refuse(f"{case_path}: {error}")
    for run in runs:
        click.echo(in_words(run), err=True)
    if picture is not None:
        warm_up_picture(picture, runs, request)
    write_json(json_path, warm_up_content(runs, request))
