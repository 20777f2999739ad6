"""`toolpoint stability warm-up`."""

from pathlib import Path

import click

from daemon.cli.common import FILE, option, refuse, say, write_json
from daemon.cli.options import LOBES_METHOD, POSITIVE, FiniteFloat, json_option, picture_option

PERCENT = FiniteFloat(min=0.0, max=40.0)


@click.command("warm-up")
@click.argument("case_path", metavar="CASE.yaml", type=FILE)
@option("--programmed-rpm", type=POSITIVE, required=True, help="Programmed spindle speed [1/min].")
@option("--depth-mm", type=POSITIVE, required=True, help="Programmed axial depth of cut [mm].")
@option("--minutes", type=click.IntRange(5, 600), default=60, help="Time of milling [min].")
@option("--feed-per-tooth-mm", type=POSITIVE, default=0.05, help="Programmed feed per tooth [mm].")
@option("--min-rpm", type=POSITIVE, default=1000.0, help="Lowest speed of the machine [1/min].")
@option(
    "--max-rpm",
    type=FiniteFloat(min=0.0, min_open=True, max=12000.0),
    default=12000.0,
    help="Highest speed; the simulated machine's own is 12000 [1/min].",
)
@option("--max-change-percent", type=POSITIVE, default=20.0, help="Greatest change of the speed [%].")
@option(
    "--margin-percent",
    type=PERCENT,
    default=20.0,
    help="The limiting depth exceeds the programmed one by this much [%].",
)
@option("--tolerance-percent", type=PERCENT, default=2.0, help="It does so this far to both sides of the speed [%].")
@option(
    "--offset-hz",
    type=FiniteFloat(),
    default=20.0,
    help="The published rule keeps the tooth-passing frequency this far below the resonance [Hz].",
)
@option(
    "--rule-axis", type=click.Choice(["x", "y"]), help="Axis that the rule follows. Without: the softer at resonance."
)
@option(
    "--method",
    type=LOBES_METHOD,
    default="zoa",
    help="Lobes that the tuning uses: zeroth-order solution, or semi-discretisation.",
)
@option(
    "--verify-with-sdm/--no-verify-with-sdm",
    default=True,
    help="Verify a chosen speed by semi-discretisation (SDM) too.",
)
@option(
    "--dynamics",
    type=click.Choice(["spindle", "case"]),
    default="spindle",
    help="spindle: finite elements of the simulated machine with its end mill of 10 or 16 mm; case: the CASE's modes.",
)
@option("--machine", "machine_seed", type=click.IntRange(0), default=1, help="Which machine.")
@option("--day", "day_seed", type=click.IntRange(0), default=1, help="Which day.")
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
        say(in_words(run))
    if picture is not None:
        warm_up_picture(picture, runs, request)
    write_json(json_path, warm_up_content(runs, request))
