"""`toolpoint dynamics bearings`: bearing properties from temperatures."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from daemon.cli.common import Command, FiniteFloat, json_option, refuse, write_json

DEGC = FiniteFloat(min=-40.0, max=150.0)
KELVIN = FiniteFloat(min=-100.0, max=100.0)
SIGNALS = {"ir": "IR", "a": "A", "f": "F", "room": "Room"}
"""Ending of the options -> label of the sensors."""
PLACES = {"ir": "spindle nose, infrared", "a": "housing, rear", "f": "front cover", "room": "ambient"}


def _temperature_options(command: Command) -> Command:
    """Add four temperatures, their changes, and the changes over 4 minutes."""
    options: list[Callable[[Command], Command]] = [
        click.option(f"--t-{name}", type=DEGC, required=True, help=f"T_{label} [degC] ({PLACES[name]}).")
        for name, label in SIGNALS.items()
    ]
    for name, label in SIGNALS.items():
        sentence = f"Change of T_{label} over each property's own interval (10 min; X: kt_34, kt_5 4 min) [K]."
        options.append(
            click.option(f"--d-{name}", f"--d-t-{name}", f"d_{name}", type=KELVIN, default=0.0, help=sentence)
        )
    for name, label in SIGNALS.items():
        sentence = f"Change of T_{label} over 4 min, where it differs from --d-{name} [K]."
        options.append(click.option(f"--d4-{name}", type=KELVIN, default=None, help=sentence))
    for option in reversed(options):
        command = option(command)
    return command


@click.command()
@click.option("--axis", type=click.Choice(["x", "y"]), required=True, help="Machine axis: Table D-1 (x) or D-2 (y).")
@_temperature_options
@click.option(
    "--bounds",
    "bounds_path",
    metavar="FILE",
    type=click.Path(path_type=Path),
    help="Physical bounds (YAML) in place of the shipped ones.",
)
@json_option
def bearings(axis: str, bounds_path: Path | None, json_path: str | None, **given: Any) -> None:
    """Bearing properties from four temperatures and their changes (5-1), with the published regressions.

    `raw` is what the regression says, `value` the same within the physical bounds, `flagged` is true where
    they differ: a flagged value is a bound, not an estimate.
    """
    import numpy as np

    from config.problems import ConfigurationError
    from config.thermomechanics import load_bounds, published_model

    try:
        regression = published_model(load_bounds(bounds_path)).axes[axis]
    except ConfigurationError as error:
        refuse(str(error))
    degc = np.array([given[f"t_{name}"] for name in SIGNALS])
    change = np.array([given[f"d_{name}"] for name in SIGNALS])
    over_4_min = np.array([given[f"d_{n}"] if given[f"d4_{n}"] is None else given[f"d4_{n}"] for n in SIGNALS])
    differences = {minutes: over_4_min if minutes == 4.0 else change for minutes in regression.intervals_min}
    found = regression.estimate(degc, differences)
    for each in found:
        beside = ""
        if each.flagged:
            beside = (
                f"   outside the physical range {each.bounds.lowest:g} to {each.bounds.highest:g}: raw {each.raw:.4g}"
            )
        click.echo(f"{each.name:6} {each.value:12.4e}{beside}", err=True)
    write_json(
        json_path, {each.name: {"raw": each.raw, "value": each.value, "flagged": each.flagged} for each in found}
    )
