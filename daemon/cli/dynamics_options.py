"""What the `toolpoint dynamics` commands share."""

from importlib.util import find_spec
from pathlib import Path
from typing import Any

import click

from daemon.cli.common import FiniteFloat

POSITIVE = FiniteFloat(min=0.0, min_open=True)
PICTURE_LIBRARIES = {".png": "matplotlib", ".html": "plotly"}

spindle_argument = click.argument("spindle_path", metavar="SPINDLE.yaml", type=click.Path(path_type=Path))
rotary_option = click.option(
    "--rotary",
    type=click.Choice(["correct", "published"]),
    help="Rotary inertia of a segment's rigid rotation; published: 4-12 as printed. Without: what the file says.",
)

trust_option = click.option(
    "--trust-units",
    is_flag=True,
    help="Take the units as stated (m/N over Hz), although the file's structure cannot have such a response.",
)


def _picture(ctx: click.Context, param: click.Parameter, value: Path | None) -> Path | None:
    """Refuse a picture that cannot be written before the work is done."""
    if value is None:
        return None
    library = PICTURE_LIBRARIES.get(value.suffix.lower())
    if library is None:
        raise click.BadParameter(f"{value}: a picture ends in {' or '.join(PICTURE_LIBRARIES)}")
    if find_spec(library) is None:
        raise click.BadParameter(f"this picture needs {library}: install toolpoint[plots]")
    if not value.parent.is_dir():
        raise click.BadParameter(f"{value}: there is no folder {value.parent}")
    return value


def _destination(ctx: click.Context, param: click.Parameter, value: Path | None) -> Path | None:
    """Refuse a file that cannot be written before the work is done."""
    if value is not None and (value.is_dir() or not value.parent.is_dir()):
        raise click.BadParameter(f"{value}: name a file in a folder that exists")
    return value


csv_option = click.option(
    "--csv",
    "csv_path",
    metavar="FILE",
    type=click.Path(path_type=Path),
    callback=_destination,
    help="Write the response as frequency_hz,receptance_re,receptance_im (Hz, m/N).",
)
picture_option = click.option(
    "--picture",
    metavar="FILE",
    type=click.Path(path_type=Path),
    callback=_picture,
    help="Draw the result: .png (still) or .html (to zoom into, complete in one file).",
)


def show_warnings(found: dict[str, Any]) -> None:
    """Write the warnings of a result on standard error."""
    for warning in found["warnings"]:
        click.echo(f"warning: {warning}", err=True)
