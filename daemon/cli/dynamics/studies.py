"""`toolpoint dynamics sensitivity` and `compare`: design studies."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from daemon.cli.common import FILE, option, say, show_warnings, write_json
from daemon.cli.options import (
    PLACE,
    POSITIVE,
    FiniteFloat,
    json_option,
    picture_option,
    rotary_option,
    spindle_argument,
)

if TYPE_CHECKING:
    from config.machine.spindle import Rotary


@click.command()
@spindle_argument
@rotary_option
@option(
    "--percent",
    type=FiniteFloat(min=0.0, max=90.0, min_open=True),
    default=5.0,
    help="By how much the moduli are off, up and down [%].",
)
@option("--count", type=click.IntRange(1, 100), default=2, help="How many modes.")
@picture_option
@json_option
def sensitivity(
    spindle_path: Path,
    rotary: "Rotary | None",
    percent: float,
    count: int,
    picture: Path | None,
    json_path: str | None,
) -> None:
    """Change of the modes of SPINDLE when the moduli of its composites are off by a percentage.

    Young's and shear moduli are varied by themselves and together; without composites all segments vary.
    """
    from config.machine.spindle_chain import found_file, read_spindle
    from daemon.workbench.dynamics.studies import sensitivity_summary

    spindle = read_spindle(spindle_path, rotary)
    found = sensitivity_summary(spindle, found_file(spindle_path), percent, count)
    show_warnings(found)
    say("moduli  change   " + "   ".join(f"mode {k + 1}: Hz, change, MAC" for k in range(count)))
    for variation in found["variations"]:
        each = "   ".join(
            f"{m['frequency_hz']:9.2f} {m['change_percent']:+6.2f} % {m['mac']:.4f}" for m in variation["modes"]
        )
        say(f"{variation['moduli']:6} {variation['percent']:+6.1f} %  {each}")
    if picture is not None:
        from daemon.workbench.dynamics.pictures import sensitivity_picture

        sensitivity_picture(picture, found)
    write_json(json_path, found)


@click.command()
@click.argument("spindle_paths", metavar="SPINDLE.yaml...", nargs=-1, required=True, type=FILE)
@rotary_option
@option("--at", type=PLACE, default="nose", help="Where the responses are compared.")
@option("--from-hz", type=POSITIVE, default=300.0, help="First frequency [Hz].")
@option("--to-hz", type=POSITIVE, default=2500.0, help="Last frequency [Hz].")
@option("--points", type=click.IntRange(2, 1_000_000), help="Number of frequencies.")
@picture_option
@json_option
def compare(
    spindle_paths: tuple[Path, ...],
    rotary: "Rotary | None",
    at: str,
    from_hz: float,
    to_hz: float,
    points: int | None,
    picture: Path | None,
    json_path: str | None,
) -> None:
    """Highest resonance of several layouts SPINDLE, each beside the first: frequency and compliance."""
    from config.machine.spindle_chain import read_spindle
    from daemon.workbench.dynamics.responses import frequencies
    from daemon.workbench.dynamics.studies import comparison_summary

    spindles = [(str(path), read_spindle(path, rotary)) for path in spindle_paths]
    band = frequencies(from_hz, to_hz, points, None)
    found = comparison_summary(spindles, at, band)
    show_warnings(found)
    for layout in found["layouts"]:
        say(
            f"{layout['frequency_hz']:9.2f} Hz {layout['compliance_m_per_n']:10.3e} m/N "
            f"{layout['compliance_change_percent']:+7.1f} %  {layout['mass_kg']:7.3f} kg  "
            f"{layout['name'] or layout['file']}"
        )
    if picture is not None:
        from daemon.workbench.dynamics.pictures import comparison_picture

        comparison_picture(picture, spindles, at, band)
    write_json(json_path, found)
