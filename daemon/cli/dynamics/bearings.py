"""`toolpoint dynamics bearings`: bearing properties from temperatures."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from daemon.cli.common import FILE, Command, option, refuse, say, write_json
from daemon.cli.options import FiniteFloat, json_option

if TYPE_CHECKING:
    from models.thermomechanics.regression import AxisRegression

DEGC = FiniteFloat(min=-40.0, max=150.0)
KELVIN = FiniteFloat(min=-100.0, max=100.0)
SIGNALS = {"ir": "IR", "a": "A", "f": "F", "room": "Room"}
"""Ending of the options -> label of the sensors."""
PLACES = {"ir": "spindle nose, infrared", "a": "housing, rear", "f": "front cover", "room": "ambient"}


def _temperature_options(command: Command) -> Command:
    """Add four temperatures, their changes, and the changes over 4 minutes."""
    options: list[Callable[[Command], Command]] = [
        option(f"--t-{name}", type=DEGC, help=f"T_{label} [degC] ({PLACES[name]}).") for name, label in SIGNALS.items()
    ]
    for name, label in SIGNALS.items():
        sentence = f"Change of T_{label} over each property's own interval (10 min; X: kt_34, kt_5 4 min) [K]."
        options.append(
            option(
                f"--d-{name}", f"--d-t-{name}", f"d_{name}", type=KELVIN, default=0.0, help=sentence, show_default=False
            )
        )
    for name, label in SIGNALS.items():
        sentence = f"Change of T_{label} over 4 min, where it differs from --d-{name} [K]."
        options.append(option(f"--d4-{name}", type=KELVIN, help=sentence))
    for each in reversed(options):
        command = each(command)
    return command


def _named(ctx: click.Context, param: click.Parameter, told: tuple[str, ...]) -> dict[str, tuple[float, float]]:
    """Return temperature and change by signal."""
    values: dict[str, tuple[float, float]] = {}
    for each in told:
        name, _, numbers = each.rpartition("=")
        degc, _, change = numbers.partition(",")
        if not name.strip():
            raise click.BadParameter(f"{each!r} is not of the form NAME=DEGC or NAME=DEGC,CHANGE")
        values[name.strip()] = (DEGC.convert(degc, param, ctx), KELVIN.convert(change or "0", param, ctx))
    return values


@click.command()
@option("--axis", type=click.Choice(["x", "y"]), required=True, help="Machine axis that the regressions are for.")
@_temperature_options
@option(
    "--model",
    "model_path",
    metavar="FILE",
    type=FILE,
    help="Model of a campaign (JSON) in place of the published tables, with signals of its own.",
)
@option(
    "--bounds",
    "bounds_path",
    metavar="FILE",
    type=FILE,
    help="Physical bounds (YAML) for the published tables, in place of the shipped ones.",
)
@option(
    "--signal",
    "named",
    metavar="NAME=DEGC[,CHANGE]",
    multiple=True,
    callback=_named,
    help="Temperature of a signal of --model, whatever it is called, and its change [K] (repeatable).",
)
@json_option
def bearings(
    axis: str,
    model_path: Path | None,
    bounds_path: Path | None,
    named: dict[str, tuple[float, float]],
    json_path: str | None,
    **given: Any,
) -> None:
    """Bearing properties from temperatures and their changes.

    The regressions are the published ones, or those of a model. `raw` is what the regression says, `value` the same
    within the physical bounds, `flagged` is true where they differ: a flagged value is a bound, not an estimate.
    """
    import numpy as np

    from models.dynamics.bearings import UNITS

    regression = _regression(axis, model_path, bounds_path)
    values = {name: (degc, change, change) for name, (degc, change) in named.items()}
    for name, label in SIGNALS.items():
        degc, change, over_4_min = (given[f"{kind}_{name}"] for kind in ("t", "d", "d4"))
        if degc is not None:
            values[label] = (degc, change, change if over_4_min is None else over_4_min)
    if missing := [signal for signal in regression.signals if signal not in values]:
        refuse(f"no temperature of {', '.join(missing)} is given: --signal {missing[0]}=DEGC[,CHANGE]")
    if unknown := sorted(named.keys() - set(regression.signals)):
        refuse(f"there is no signal {', '.join(unknown)}; the regressions take {', '.join(regression.signals)}")
    degc, change, over_4_min = np.array([values[signal] for signal in regression.signals]).T
    changes = {minutes: over_4_min if minutes == 4.0 else change for minutes in regression.intervals_min}
    found = regression.estimate(degc, changes)
    for each in found:
        beside = ""
        if each.flagged:
            beside = (
                f"   outside the physical range {each.bounds.lowest:g} to {each.bounds.highest:g}: raw {each.raw:.4g}"
            )
        say(f"{each.name:6} {each.value:12.4e} {UNITS[each.name[:2]]:9}{beside}".rstrip())
    write_json(
        json_path, {each.name: {"raw": each.raw, "value": each.value, "flagged": each.flagged} for each in found}
    )


def _regression(axis: str, model_path: Path | None, bounds_path: Path | None) -> "AxisRegression":
    """Return the regressions that are asked for, or end with a sentence."""
    from config.machine.published_bearings import load_bounds, published_model
    from models.thermomechanics.artifact import model_from_json

    try:
        if model_path is None:
            return published_model(load_bounds(bounds_path)).axes[axis]
        model = model_from_json(model_path.read_text(encoding="utf-8"), str(model_path))
    except OSError as error:
        refuse(f"{model_path}: cannot be opened ({error.strerror})")
    except UnicodeDecodeError:
        refuse(f"{model_path}: is not text; a model is JSON")
    if bounds_path is not None:
        refuse("a model carries its own bounds; give --bounds when it is fitted")
    if axis not in model.axes:
        refuse(f"{model_path}: holds no regressions for axis {axis}, only for {', '.join(model.axes)}")
    return model.axes[axis]
