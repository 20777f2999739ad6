"""`toolpoint dynamics identify` and `contact`: properties from measured frequency responses."""

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from daemon.cli.common import FILE, option, refuse, say, show_warnings, write_json
from daemon.cli.options import (
    POSITIVE,
    FiniteFloat,
    json_option,
    picture_option,
    rotary_option,
    spindle_argument,
    trust_option,
)

if TYPE_CHECKING:
    from config.machine.spindle import Rotary
    from models.dynamics.identification import Method

measured_argument = click.argument("measured", metavar="MEASURED...", nargs=-1, required=True, type=FILE)
method_option = option(
    "--method",
    type=click.Choice(["lm", "nelder-mead"]),
    default="lm",
    help="lm: least squares of the logarithm; nelder-mead: the simplex on the published sum of errors.",
)
from_option = option("--from-hz", type=POSITIVE, help="Use no lower frequencies [Hz].")
to_option = option("--to-hz", type=POSITIVE, help="Use no higher frequencies [Hz].")
coherence_option = option(
    "--least-coherence", type=FiniteFloat(min=0.0, max=1.0), help="Use only frequencies with at least this coherence."
)


vary_option = option(
    "--vary",
    metavar="NAME,...",
    callback=lambda _context, _option, told: tuple(each.strip() for each in told.split(",")) if told else (),
    help="What is varied instead: parameters (kt_front), kinds (kt: of every group) or groups (front); the others are "
    "kept at SPINDLE's values.",
)


@click.command()
@spindle_argument
@measured_argument
@rotary_option
@option(
    "--parameters",
    type=click.Choice(["auto", "5", "7", "12"]),
    default="auto",
    help="How many bearing parameters are varied; the others are kept. auto: 5 for the groups 12, 34 and 5 where they "
    "explain the response, else all.",
)
@vary_option
@method_option
@option(
    "--fixed",
    type=click.Choice(["auto", "source", "file"]),
    default="auto",
    help="Kept parameters: source, the published values; file, SPINDLE's; auto, published unless only SPINDLE's fit.",
)
@from_option
@to_option
@coherence_option
@trust_option
@picture_option
@json_option
def identify(
    spindle_path: Path,
    measured: tuple[Path, ...],
    rotary: "Rotary | None",
    parameters: str,
    vary: tuple[str, ...],
    method: "Method",
    fixed: Literal["auto", "source", "file"],
    from_hz: float | None,
    to_hz: float | None,
    least_coherence: float | None,
    trust_units: bool,
    picture: Path | None,
    json_path: str | None,
) -> None:
    """Bearing properties of SPINDLE from responses MEASURED at its nose (CSV or universal file).

    Several responses are averaged. Which parameters the data see is said for each.
    """
    from config.machine.spindle_chain import read_spindle
    from daemon.workbench.dynamics.identifying import Band, bearings_summary, kept_for, measured_response
    from daemon.workbench.dynamics.responses import ResponseError
    from models.dynamics.measurement import MeasurementError
    from models.errors import IdentificationError

    try:
        spindle = read_spindle(spindle_path, rotary)
        kept, why = kept_for(spindle, parameters, vary)
        if why:
            click.echo(why, err=True)
        band = Band(from_hz=from_hz, to_hz=to_hz, least_coherence=least_coherence, trust_units=trust_units)
        count = 4 * len({support.group for support in spindle.shaft.supports}) - len(kept)
        response = measured_response(measured, band, count)
        open_count = parameters == "auto" and not vary
        found = bearings_summary(
            spindle, response, kept, method, fixed, may_vary_all=open_count, trust_units=trust_units
        )
    except MeasurementError as error:
        refuse(f"{', '.join(map(str, measured))}: {error}")
    except (ResponseError, IdentificationError) as error:
        refuse(f"{spindle_path}: {error}")
    show_identified(found)
    if picture is not None:
        from daemon.workbench.dynamics.pictures import identified_picture

        identified_picture(picture, spindle, response, found)
    write_json(json_path, found)


@click.command()
@spindle_argument
@measured_argument
@rotary_option
@option(
    "--joint",
    type=click.Choice(["spindle-holder", "holder-tool", "shaft"]),
    required=True,
    help="Measured at the holder's front, at the tool's tip, or at the nose of the shaft.",
)
@option("--after-segment", type=click.IntRange(1), help="Segment in front of a joint in the shaft, from 1.")
@method_option
@from_option
@to_option
@coherence_option
@trust_option
@json_option
def contact(
    spindle_path: Path,
    measured: tuple[Path, ...],
    rotary: "Rotary | None",
    joint: str,
    after_segment: int | None,
    method: "Method",
    from_hz: float | None,
    to_hz: float | None,
    least_coherence: float | None,
    trust_units: bool,
    json_path: str | None,
) -> None:
    """Stiffness and damping of a joint of SPINDLE from responses MEASURED in front of it (CSV or universal file)."""
    from config.machine.spindle_chain import read_spindle
    from daemon.workbench.dynamics.identifying import Band, contact_summary, measured_response
    from daemon.workbench.dynamics.responses import ResponseError
    from models.dynamics.measurement import MeasurementError
    from models.errors import IdentificationError

    try:
        spindle = read_spindle(spindle_path, rotary)
        band = Band(from_hz=from_hz, to_hz=to_hz, least_coherence=least_coherence, trust_units=trust_units)
        response = measured_response(measured, band, 4)
        found = contact_summary(spindle, response, joint, after_segment, method, trust_units=trust_units)
    except MeasurementError as error:
        refuse(f"{', '.join(map(str, measured))}: {error}")
    except (ResponseError, IdentificationError) as error:
        refuse(f"{spindle_path}: {error}")
    show_identified(found)
    write_json(json_path, found)


def show_identified(found: dict[str, Any]) -> None:
    from models.dynamics.bearings import UNITS

    show_warnings(found)
    for name, value in found["values"].items():
        low, high = found["interval"][name]
        between = f"{'0' if low is None else f'{low:.3g}'} to {'any value' if high is None else f'{high:.3g}'}"
        seen = "" if found["identifiable"][name] else "   not determined by the data"
        say(f"{name:6} {value:12.4e} {UNITS[name[:2]]:9}   {between}{seen}")
    for name, value in found["fixed"].items():
        whose = "published value" if found["fixed_from"] == "source" else "file's value"
        say(f"{name:6} {value:12.4e} {UNITS[name[:2]]:9}   not varied, the {whose}: belongs to the others")
    say(
        f"cost {found['cost']:.3e} m/N, mean |log(H/H_meas)| {found['log_error']:.2e}, "
        f"{found['evaluations']} evaluations"
    )
