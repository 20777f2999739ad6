"""`toolpoint stability`: lobes, spindle speed, chatter."""

import math
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from daemon.cli.common import FiniteFloat, json_option, refuse, write_json

if TYPE_CHECKING:
    from models.stability.lobes_zoa import StabilityLobes

POSITIVE = FiniteFloat(min=0.0, min_open=True)


def _points(ctx: click.Context, param: click.Parameter, value: tuple[str, ...]) -> tuple[tuple[float, float], ...]:
    found = []
    for text in value:
        speed, _, depth = text.partition(":")
        try:
            point = float(speed), float(depth)
        except ValueError:
            raise click.BadParameter(f"{text!r} is no speed and depth such as 12000:0.5") from None
        if not all(math.isfinite(number) and number > 0.0 for number in point):
            raise click.BadParameter(f"{text!r}: speed and depth must be above 0")
        found.append(point)
    return tuple(found)


@click.group()
def stability() -> None:
    """Stability of milling: lobes, a stable spindle speed, chatter in recordings."""


@stability.command()
@click.argument("case_path", metavar="CASE.yaml", type=click.Path(path_type=Path))
@click.option(
    "--method",
    type=click.Choice(["zoa", "sdm"]),
    default="zoa",
    show_default=True,
    help="zoa: zeroth-order solution; sdm: semi-discretisation, which also shows flip lobes.",
)
@click.option("--from-rpm", type=POSITIVE, default=2000.0, show_default=True, help="First spindle speed [1/min].")
@click.option("--to-rpm", type=POSITIVE, default=14000.0, show_default=True, help="Last spindle speed [1/min].")
@click.option("--points", type=click.IntRange(2, 20000), help="Number of speeds. Without: 400 (zoa), 100 (sdm).")
@click.option(
    "--max-depth-mm",
    type=POSITIVE,
    help="Look no deeper than this [mm]; a speed that is stable up to there shows this depth and no frequency.",
)
@click.option(
    "--at",
    "at",
    metavar="RPM:DEPTH_MM",
    multiple=True,
    callback=_points,
    help="Spectral radius at this speed and depth (sdm; may be repeated); without the lobes.",
)
@click.option("--steps", type=click.IntRange(8, 2000), help="Steps per tooth passing (sdm). Without: 200 for --at.")
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
    json_path: str | None,
) -> None:
    """Limiting depth of cut over spindle speed for the milling CASE."""
    from config.problems import ConfigurationError
    from config.stability_case import load_stability_case
    from daemon.stability.lobes import LobesRequest, find_lobes, radii_at
    from drivers.frf_csv import FrfFileError
    from models.stability.errors import StabilityError

    if method == "zoa" and (at or steps is not None):
        refuse("--at and --steps belong to the semi-discretisation; add --method sdm")
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
    except (ConfigurationError, FrfFileError) as error:
        refuse(str(error))
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
        depths.append(max_depth_mm if beyond else float(depth))
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


def _show(found: "StabilityLobes") -> None:
    for warning in found.warnings:
        click.echo(f"warning: {warning}", err=True)
    minimum = found.minimum
    if minimum is None:
        return
    click.echo(
        f"{found.speed_rpm[0]:g} to {found.speed_rpm[-1]:g} 1/min: stable everywhere up to {minimum.depth_mm:.4g} mm "
        f"(lowest at {minimum.speed_rpm:.0f} 1/min, chatter at {minimum.chatter_hz:.1f} Hz)",
        err=True,
    )


def _show_radii(content: dict[str, Any]) -> None:
    for point in content["points"]:
        word = "stable" if point["spectral_radius"] < 1.0 else "chatter"
        click.echo(
            f"{point['speed_rpm']:g} 1/min, {point['depth_mm']:g} mm: {word} "
            f"(spectral radius {point['spectral_radius']:.6f})",
            err=True,
        )
