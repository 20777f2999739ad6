"""`toolpoint dynamics`: modes and frequency responses of a spindle, and what is identified from measured ones."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from config.files import write_whole
from daemon.cli.command_group import Group
from daemon.cli.common import FILE, option, refuse, say, show_warnings, write_json
from daemon.cli.dynamics.bearings import bearings
from daemon.cli.dynamics.campaign import campaign, simulate_campaign, track
from daemon.cli.dynamics.identify import contact, from_option, identify, to_option
from daemon.cli.options import (
    FOLDER,
    PLACE,
    POSITIVE,
    FiniteFloat,
    csv_option,
    json_option,
    picture_option,
    rotary_option,
    spindle_argument,
    trust_option,
)

if TYPE_CHECKING:
    from config.machine.spindle import Rotary


turning_option = option(
    "--speed-rpm",
    type=FiniteFloat(min=0.0, min_open=True, max=1e6),
    help="The shaft turns at this speed, with gyroscopic moments; bearings alike in both axes [1/min].",
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
    spindle_path: Path, rotary: "Rotary | None", percent: float, count: int, picture: Path | None, json_path: str | None
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


@click.command()
@click.argument("test_path", metavar="TEST.yaml", type=FILE)
@click.argument("library_path", metavar="TOOLS.yaml", type=FILE)
@from_option
@to_option
@trust_option
@option(
    "--output-dir", type=FOLDER, help="Write each tool's response into this folder, as NAME.csv for a stability case."
)
@json_option
def blank(
    test_path: Path,
    library_path: Path,
    from_hz: float | None,
    to_hz: float | None,
    trust_units: bool,
    output_dir: Path | None,
    json_path: str | None,
) -> None:
    """Responses at the tips of all TOOLS from one impact TEST on a plain cylinder in the same holder."""
    from config.machine.blank import read_blank, read_tools
    from daemon.workbench.dynamics.blanks import blank_summary, measured_blank
    from daemon.workbench.dynamics.identifying import Band
    from models.dynamics.measurement import MeasurementError
    from models.errors import IdentificationError

    tested = read_blank(test_path)
    tools = read_tools(library_path, tested)
    try:
        frequency_hz, measured = measured_blank(tested, Band(from_hz=from_hz, to_hz=to_hz, trust_units=trust_units))
        found = blank_summary(tested, tools, frequency_hz, measured)
    except (MeasurementError, IdentificationError) as error:
        refuse(f"{test_path}: {error}")
    show_warnings(found)
    for name, tool in found["tools"].items():
        between = tool["peak_hz_interval"]
        about = f" ({between[0]:.0f} to {between[1]:.0f})" if between else ""
        say(f"{name}: peak {tool['peak_hz']:.1f} Hz{about}, {tool['peak_m_per_n']:.3e} m/N")
    if output_dir is not None:
        output_dir.mkdir(parents=True, exist_ok=True)
        for name, tool in found["tools"].items():
            rows = zip(found["frequency_hz"], tool["receptance_re"], tool["receptance_im"], strict=True)
            lines = ["frequency_hz,receptance_re,receptance_im", *(f"{f!r},{re!r},{im!r}" for f, re, im in rows)]
            write_whole(output_dir / f"{name}.csv", "\n".join(lines) + "\n")
    write_json(json_path, found)


@click.group(cls=Group)
def dynamics() -> None:
    """Spindle dynamics: modes, frequency responses, bearing properties, design studies."""


@dynamics.command()
@spindle_argument
@rotary_option
@option("--count", type=click.IntRange(1, 100), default=6, help="How many modes.")
@turning_option
@picture_option
@json_option
def modes(
    spindle_path: Path,
    rotary: "Rotary | None",
    count: int,
    speed_rpm: float | None,
    picture: Path | None,
    json_path: str | None,
) -> None:
    """Undamped natural frequencies and mode shapes of SPINDLE, free or on its bearings as the file says.

    SPINDLE is a file or the name of one that ships. Positions count from the nose backwards.
    """
    from config.machine.spindle_chain import read_spindle
    from daemon.workbench.dynamics.responses import ResponseError, modes_summary, whirls_of

    spindle = read_spindle(spindle_path, rotary)
    found = modes_summary(spindle, count)
    if speed_rpm is not None:
        try:
            found["whirl"] = whirls_of(spindle, speed_rpm, count)
        except ResponseError as error:
            refuse(f"{spindle_path}: {error}")
    show_warnings(found)
    say(f"{found['mass_kg']:.3f} kg, {found['length_mm']:.1f} mm long")
    for number, mode in enumerate(found["modes"], start=1):
        say(f"mode {number:2}: {mode['frequency_hz']:10.2f} Hz")
    if speed_rpm is not None:
        say(f"at {speed_rpm:g} 1/min, whirling against and with the rotation:")
        pairs = zip(found["whirl"]["backward_hz"], found["whirl"]["forward_hz"], strict=True)
        for number, (against, along) in enumerate(pairs, start=1):
            say(f"mode {number:2}: {against:10.2f} Hz {along:10.2f} Hz")
    if picture is not None:
        from daemon.workbench.dynamics.pictures import modes_picture

        modes_picture(picture, spindle, found)
    write_json(json_path, found)


@dynamics.command()
@spindle_argument
@rotary_option
@option(
    "--at",
    type=PLACE,
    default="nose",
    help="nose: of the spindle alone; holder: its front, without tool; tool: the tip.",
)
@option("--from-hz", type=POSITIVE, default=300.0, help="First frequency [Hz].")
@option("--to-hz", type=POSITIVE, default=2500.0, help="Last frequency [Hz].")
@option("--points", type=click.IntRange(2, 1_000_000), help="Number of frequencies.")
@option("--df", "step_hz", type=POSITIVE, help="Step between frequencies [Hz]. Without both: 12800/16384.")
@turning_option
@csv_option
@picture_option
@json_option
def frf(
    spindle_path: Path,
    rotary: "Rotary | None",
    at: str,
    from_hz: float,
    to_hz: float,
    points: int | None,
    step_hz: float | None,
    speed_rpm: float | None,
    csv_path: Path | None,
    picture: Path | None,
    json_path: str | None,
) -> None:
    """Receptance of SPINDLE where it is hit: displacement per force [m/N] over frequency."""
    from config.machine.spindle_chain import read_spindle
    from daemon.workbench.dynamics.responses import ResponseError, frequencies, response_summary

    try:
        spindle = read_spindle(spindle_path, rotary)
        found = response_summary(spindle, at, frequencies(from_hz, to_hz, points, step_hz), speed_rpm or 0.0)
    except ResponseError as error:
        refuse(f"{spindle_path}: {error}")
    show_warnings(found)
    for peak in found["peaks"]:
        say(f"peak {peak['frequency_hz']:10.2f} Hz {peak['magnitude_m_per_n']:10.3e} m/N")
    if csv_path is not None:
        rows = zip(found["frequency_hz"], found["receptance_re"], found["receptance_im"], strict=True)
        lines = ["frequency_hz,receptance_re,receptance_im", *(f"{f!r},{re!r},{im!r}" for f, re, im in rows)]
        write_whole(csv_path, "\n".join(lines) + "\n")
    if picture is not None:
        from daemon.workbench.dynamics.pictures import response_picture

        response_picture(picture, found)
    write_json(json_path, found)


for command in (identify, contact, blank, sensitivity, compare, bearings, campaign, simulate_campaign, track):
    dynamics.add_command(command)
