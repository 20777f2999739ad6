"""What the `toolpoint dynamics` commands share."""

from pathlib import Path
from typing import Any

import click

from daemon.cli.common import FiniteFloat

POSITIVE = FiniteFloat(min=0.0, min_open=True)
PICTURE_ENDINGS = (".png", ".html")

spindle_argument = click.argument("spindle_path", metavar="SPINDLE.yaml", type=click.Path(path_type=Path))
rotary_option = click.option(
    "--rotary",
    type=click.Choice(["correct", "published"]),
    help="Rotary inertia of a segment's rigid rotation; published: 4-12 as printed. Without: what the file says.",
)


def _picture(ctx: click.Context, param: click.Parameter, value: Path | None) -> Path | None:
    """Refuse a picture that cannot be written before the work is done."""
    if value is None:
        return None
    if value.suffix.lower() not in PICTURE_ENDINGS:
        raise click.BadParameter(f"{value}: a picture ends in {' or '.join(PICTURE_ENDINGS)}")
    if not value.parent.is_dir():
        raise click.BadParameter(f"{value}: there is no folder {value.parent}")
    return value


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
