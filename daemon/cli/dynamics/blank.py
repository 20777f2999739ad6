"""`toolpoint dynamics blank`: tool points of a library of tools from one impact test on a blank."""

from pathlib import Path

import click

from daemon.cli.common import FILE, option, refuse, say, show_warnings, write_json
from daemon.cli.dynamics.identify import from_option, to_option
from daemon.cli.options import FOLDER, json_option, trust_option


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
            (output_dir / f"{name}.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    write_json(json_path, found)
