"""`toolpoint stability`: lobes, spindle speed, chatter."""

import math
import sys
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from daemon.cli.command_group import Group
from daemon.cli.common import FILE, option, refuse, say, write_json
from daemon.cli.options import LOBES_METHOD, NOT_NEGATIVE, POSITIVE, FiniteFloat, json_option, picture_option
from daemon.cli.stability.recordings import chatter, roughness
from daemon.cli.stability.studies import coefficients, compare, modes
from daemon.cli.stability.warm_up import warm_up
from models.json_values import finite_or_none

if TYPE_CHECKING:
    from models.stability.lobes import StabilityLobes

FASTEST_RPM, DEEPEST_MM = 1e6, 1e4
"""Beyond these a number is a slip of the pen."""
SPEED = FiniteFloat(min=0.0, min_open=True, max=FASTEST_RPM)
DEPTH = FiniteFloat(min=0.0, min_open=True, max=DEEPEST_MM)


def _points(ctx: click.Context, param: click.Parameter, value: tuple[str, ...]) -> tuple[tuple[float, float], ...]:
    found = []
    for text in value:
        speed, _, depth = text.partition(":")
        try:
            point = float(speed), float(depth)
        except ValueError:
            raise click.BadParameter(f"{text!r} is no speed and depth such as 12000:0.5") from None
        if not (0.0 < point[0] <= FASTEST_RPM and 0.0 < point[1] <= DEEPEST_MM):
            raise click.BadParameter(
                f"{text!r}: the speed must be above 0 and at most {FASTEST_RPM:g} 1/min, the depth above 0 and at most "
                f"{DEEPEST_MM:g} mm"
            )
        found.append(point)
    return tuple(found)


@click.group(cls=Group)
def stability() -> None:
    """Stability of milling: lobes, a stable spindle speed, chatter in recordings."""


for _command in (chatter, roughness, compare, modes, coefficients, warm_up):
    stability.add_command(_command)


@stability.command()
@click.argument("case_path", metavar="CASE.yaml", type=FILE)
@option(
    "--method",
    type=LOBES_METHOD,
    default="zoa",
    help="zoa: zeroth-order solution; sdm: from the periodic cut itself, which also shows flip lobes.",
)
@option("--from-rpm", type=SPEED, default=2000.0, help="First spindle speed [1/min].")
@option("--to-rpm", type=SPEED, default=14000.0, help="Last spindle speed [1/min].")
@option(
    "--points",
    type=click.IntRange(2, 20000),
    help="Number of speeds. Without: 400 (zoa), 100 (sdm), 60 of a spindle that turns.",
)
@option(
    "--max-depth-mm",
    type=DEPTH,
    help="Look no deeper than this [mm]; a speed that is stable up to there shows this depth and no frequency.",
)
@option(
    "--at",
    "at",
    metavar="RPM:DEPTH_MM",
    multiple=True,
    callback=_points,
    help="Spectral radius at this speed and depth (sdm; may be repeated); without the lobes.",
)
@option(
    "--steps",
    type=click.IntRange(8, 2000),
    help="Steps per tooth passing of the semi-discretisation; without: by collocation.",
)
@option(
    "--band", is_flag=True, help="Add between which depths the limit lies, by the uncertainty that the case states."
)
@picture_option
@json_option
def lobes(
    case_path: Path,
    method: str,
    from_rpm: float,
    to_rpm: float,
    points: int | None,
    max_depth_mm: float | None,
    at: tuple[tuple[float, float], ...],
    steps: int | None,
    band: bool,
    picture: Path | None,
    json_path: str | None,
) -> None:
    """Limiting depth of cut over spindle speed for the milling CASE."""
    from config.machine.stability_case import load_stability_case
    from daemon.workbench.stability.lobes import LobesRequest, find_band, find_lobes, radii_at
    from models.errors import StabilityError

    if method == "zoa" and (at or steps is not None):
        refuse("--at and --steps belong to the semi-discretisation; add --method sdm")
    if at and band:
        refuse("--band belongs to lobes, --at to single points; leave out one of them")
    if at and picture is not None:
        refuse("--at gives numbers, not lobes to draw; leave out one of --at and --picture")
    request = LobesRequest(
        method=method, from_rpm=from_rpm, to_rpm=to_rpm, points=points, max_depth_mm=max_depth_mm, steps=steps
    )
    try:
        case = load_stability_case(case_path)
        if at:
            content = radii_at(case, at, steps)
            _show_radii(content)
        else:
            found = find_lobes(case, request)
            content = lobes_content(found, method, max_depth_mm)
            _show(found)
            diagrams = [(case_path.stem, found)]
            if band:
                limits = find_band(case, request)
                for name, depths in (("depth_low_mm", limits.low_mm), ("depth_high_mm", limits.high_mm)):
                    content[name] = [_shown_depth(each, content["max_depth_mm"]) for each in depths]
                lowest = replace(found, limiting_depth_mm=limits.low_mm)
                lowest_mm = _shown_depth(float(limits.low_mm.min()), content["max_depth_mm"])
                words = "no limit is found" if lowest_mm is None else f"stable everywhere up to {lowest_mm:.4g} mm"
                say(f"as far as the case's numbers are known: {words}")
                diagrams.append(("careful", lowest))
            if picture is not None:
                from daemon.workbench.stability.pictures import lobes_picture

                lobes_picture(picture, diagrams)
    except StabilityError as error:
        refuse(f"{case_path}: {error}")
    write_json(json_path, content)


def lobes_content(found: "StabilityLobes", method: str, max_depth_mm: float | None) -> dict[str, Any]:
    """Return lobes as JSON; a depth at `max_depth_mm` [mm] without a frequency is stable up to there."""
    if max_depth_mm is None and math.isfinite(found.max_depth_mm):
        max_depth_mm = found.max_depth_mm
    depths, chatter = [], []
    for depth, frequency in zip(found.limiting_depth_mm, found.chatter_hz, strict=True):
        beyond = not math.isfinite(depth) or (max_depth_mm is not None and depth > max_depth_mm)
        depths.append(_shown_depth(depth, max_depth_mm))
        chatter.append(None if beyond or not math.isfinite(frequency) else float(frequency))
    return {
        "method": method,
        "feed_deg": found.feed_deg,
        "speed_rpm": [float(speed) for speed in found.speed_rpm],
        "limiting_depth_mm": depths,
        "chatter_hz": chatter,
        "max_depth_mm": max_depth_mm,
        "minimum": None if found.minimum is None else asdict(found.minimum),
        "warnings": list(found.warnings),
    }


def _shown_depth(depth_mm: float, max_depth_mm: float | None) -> float | None:
    beyond = not math.isfinite(depth_mm) or (max_depth_mm is not None and depth_mm > max_depth_mm)
    return max_depth_mm if beyond else float(depth_mm)


def _show(found: "StabilityLobes") -> None:
    for warning in found.warnings:
        say(f"warning: {warning}")
    minimum = found.minimum
    if minimum is None:
        return
    say(
        f"{found.speed_rpm[0]:g} to {found.speed_rpm[-1]:g} 1/min: stable everywhere up to {minimum.depth_mm:.4g} mm "
        f"(lowest at {minimum.speed_rpm:.0f} 1/min, chatter at {minimum.chatter_hz:.1f} Hz)"
    )


def _show_radii(content: dict[str, Any]) -> None:
    for point in content["points"]:
        word = "stable" if point["spectral_radius"] < 1.0 else "chatter"
        say(
            f"{point['speed_rpm']:g} 1/min, {point['depth_mm']:g} mm: {word} "
            f"(spectral radius {point['spectral_radius']:.6f})"
        )


@stability.command()
@option("--resonance-hz", type=POSITIVE, required=True, help="Tracked resonance f_r [Hz].")
@option("--offset-hz", type=FiniteFloat(), default=20.0, help="Signed offset f_o below it [Hz].")
@option("--teeth", type=click.IntRange(1, 100), required=True, help="Number of teeth.")
@option("--lobe", type=click.IntRange(1), default=1, help="Lobe number; 1 is the fastest.")
@json_option
def speed(resonance_hz: float, offset_hz: float, teeth: int, lobe: int, json_path: str | None) -> None:
    """Spindle speed from a resonance: 60 (f_r - f_o) / (teeth x lobe)."""
    from models.spindle_speed.choice import resonance_speed_rpm

    speed_rpm = resonance_speed_rpm(resonance_hz, offset_hz, teeth, lobe)
    say(f"{speed_rpm:.1f} 1/min")
    write_json(
        json_path,
        {"speed_rpm": speed_rpm, "resonance_hz": resonance_hz, "offset_hz": offset_hz, "teeth": teeth, "lobe": lobe},
    )


@stability.command()
@click.argument("case_path", metavar="CASE.yaml", type=FILE)
@option("--programmed-rpm", type=SPEED, required=True, help="Programmed spindle speed [1/min].")
@option("--depth-mm", type=DEPTH, required=True, help="Programmed axial depth of cut [mm].")
@option("--min-rpm", type=SPEED, default=1000.0, help="Lowest speed of the machine [1/min].")
@option("--max-rpm", type=SPEED, default=14000.0, help="Highest speed of machine and tool [1/min].")
@option("--max-change-percent", type=POSITIVE, default=20.0, help="Greatest change against the programmed speed [%].")
@option(
    "--margin-percent",
    type=NOT_NEGATIVE,
    default=20.0,
    help="The limiting depth exceeds the programmed one by this much [%].",
)
@option(
    "--tolerance-percent",
    type=FiniteFloat(min=0.0, max=40.0),
    default=1.0,
    help="It does so this far to both sides of the speed [%].",
)
@option("--feed-mm-min", type=POSITIVE, help="Programmed feed [mm/min], to be changed with the speed.")
@option("--method", type=LOBES_METHOD, default="zoa", help="zoa: zeroth-order solution; sdm: semi-discretisation.")
@json_option
def choose(
    case_path: Path,
    programmed_rpm: float,
    depth_mm: float,
    min_rpm: float,
    max_rpm: float,
    max_change_percent: float,
    margin_percent: float,
    tolerance_percent: float,
    feed_mm_min: float | None,
    method: str,
    json_path: str | None,
) -> None:
    """Choose the stable spindle speed nearest to the programmed one for the milling CASE.

    Exit status 1, with the programmed speed and an alarm, when no speed inside the limits is stable.
    """
    from config.machine.stability_case import load_stability_case
    from daemon.workbench.stability.lobes import choose_for_case
    from models.errors import StabilityError
    from models.spindle_speed.choice import SpeedDemand, SpeedLimits

    limits = SpeedLimits(
        machine_lowest_rpm=min_rpm, machine_highest_rpm=max_rpm, within_fraction=max_change_percent / 100.0
    )
    demand = SpeedDemand(
        programmed_rpm=programmed_rpm,
        depth_mm=depth_mm,
        margin_fraction=margin_percent / 100.0,
        tolerance_fraction=tolerance_percent / 100.0,
    )
    try:
        choice, warnings = choose_for_case(load_stability_case(case_path), demand, limits, method)
    except StabilityError as error:
        refuse(f"{case_path}: {error}")
    for warning in warnings:
        say(f"warning: {warning}")
    depth = finite_or_none(choice.limiting_depth_mm)
    feed = None if feed_mm_min is None else feed_mm_min * choice.speed_rpm / programmed_rpm
    pair = f"S{choice.speed_rpm:.0f}" + ("" if feed is None else f" F{feed:.0f}")
    words = "unlimited" if depth is None else f"{depth:.3g} mm"
    say(f"{pair}: limiting depth {words}" if choice.stable else str(choice.alarm))
    content = {
        "speed_rpm": choice.speed_rpm,
        "feed_mm_min": feed,
        "limiting_depth_mm": depth,
        "pocket_rpm": list(choice.pocket_rpm),
        "stable": choice.stable,
        "alarm": choice.alarm,
        "warnings": list(warnings),
    }
    write_json(json_path, content)
    sys.exit(0 if choice.stable else 1)
