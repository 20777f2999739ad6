"""`toolpoint stability compare`, `modes` and `coefficients`."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import click

from daemon.cli.common import FILE, option, refuse, say, write_json
from daemon.cli.options import LOBES_METHOD, POSITIVE, json_option, picture_option
from models.json_values import finite_or_none


@click.command()
@click.argument("case_paths", metavar="CASE.yaml...", nargs=-1, required=True, type=FILE)
@option("--from-rpm", type=POSITIVE, default=2000.0, help="First spindle speed [1/min].")
@option("--to-rpm", type=POSITIVE, default=14000.0, help="Last spindle speed [1/min].")
@option("--points", type=click.IntRange(2, 20000), default=400, help="Number of speeds.")
@option("--method", type=LOBES_METHOD, default="zoa", help="zoa: zeroth-order solution; sdm: semi-discretisation.")
@option("--programmed-rpm", type=POSITIVE, help="Programmed speed [1/min]; with --depth-mm a speed is chosen.")
@option("--depth-mm", type=POSITIVE, help="Programmed axial depth of cut [mm].")
@picture_option
@json_option
def compare(
    case_paths: tuple[Path, ...],
    from_rpm: float,
    to_rpm: float,
    points: int,
    method: str,
    programmed_rpm: float | None,
    depth_mm: float | None,
    picture: Path | None,
    json_path: str | None,
) -> None:
    """Lobes of several CASE files side by side, such as one machine cold and warm, with the speed chosen in each."""
    from daemon.workbench.stability.lobes import LobesRequest
    from daemon.workbench.stability.studies import compare_cases
    from models.spindle_speed.choice import SpeedDemand

    if (programmed_rpm is None) != (depth_mm is None):
        refuse("--programmed-rpm and --depth-mm belong together; a speed is chosen only with both")
    demand = None
    if programmed_rpm is not None and depth_mm is not None:
        demand = SpeedDemand(programmed_rpm=programmed_rpm, depth_mm=depth_mm)
    request = LobesRequest(method=method, from_rpm=from_rpm, to_rpm=to_rpm, points=points)
    found = compare_cases(case_paths, request, demand)
    content = []
    for path, lobes, choice in found:
        lowest = "none" if lobes.minimum is None else f"{lobes.minimum.depth_mm:.4g} mm"
        words = (
            ""
            if choice is None
            else f", S{choice.speed_rpm:.0f}{'' if choice.stable else ' (' + str(choice.alarm) + ')'}"
        )
        say(f"{path}: lowest limit {lowest}{words}")
        content.append(
            {
                "case": str(path),
                "minimum": None if lobes.minimum is None else asdict(lobes.minimum),
                "speed_rpm": None if choice is None else choice.speed_rpm,
                "limiting_depth_mm": finite_or_none(None if choice is None else choice.limiting_depth_mm),
                "alarm": None if choice is None else choice.alarm,
            }
        )
    if picture is not None:
        from daemon.workbench.stability.pictures import lobes_picture

        lobes_picture(
            picture,
            [(path.stem, lobes) for path, lobes, _ in found],
            commanded=[choice.speed_rpm if choice is not None and choice.stable else None for *_, choice in found],
            depth_mm=depth_mm,
        )
    write_json(json_path, {"method": method, "cases": content})


@click.command()
@click.argument("case_path", metavar="CASE.yaml", type=FILE)
@picture_option
@json_option
def modes(case_path: Path, picture: Path | None, json_path: str | None) -> None:
    """Modes fitted to the FRF files of a CASE, as the semi-discretisation uses them."""
    from config.machine.stability_case import load_stability_case
    from daemon.workbench.stability.studies import fitted_modes, modes_content
    from models.errors import StabilityError

    try:
        found = fitted_modes(load_stability_case(case_path))
    except StabilityError as error:
        refuse(f"{case_path}: {error}")
    content: dict[str, Any] = {name: modes_content(fit) for name, (_, fit) in found.items()}
    for name, part in content.items():
        for warning in part["warnings"]:
            say(f"warning: {name}: {warning}")
        for mode in part["modes"]:
            say(f"{name}: {mode['frequency_hz']:.1f} Hz, damping ratio {mode['damping_ratio']:.4f}")
        say(f"{name}: residual {part['relative_residual']:.2%} of the response")
    if picture is not None:
        from daemon.workbench.stability.pictures import responses_picture

        curves = [
            (name, samples.frequency_hz, samples.receptance_m_per_n, fit) for name, (samples, fit) in found.items()
        ]
        responses_picture(picture, curves, case_path.stem)
    write_json(json_path, content)


@click.command()
@click.argument("forces_path", metavar="[FORCES.csv]", required=False, type=FILE)
@option("--case", "case_path", type=FILE, help="The case that was cut (tool, engagement).")
@option("--depth-mm", type=POSITIVE, help="Axial depth of cut of the measurement [mm].")
@json_option
def coefficients(
    forces_path: Path | None, case_path: Path | None, depth_mm: float | None, json_path: str | None
) -> None:
    """Known cutting coefficients, or those that mean FORCES at several feeds give.

    FORCES.csv has the columns feed_per_tooth_mm, mean_force_x_n (along the feed) and mean_force_y_n (to its left):
    mean forces on the tool over whole turns.
    """
    from config.machine.stability_case import load_stability_case
    from daemon.workbench.stability.studies import coefficients_content, fit_force_file
    from models.stability.cutting_coefficients import MATERIALS

    if forces_path is None:
        for name, known in MATERIALS.items():
            say(
                f"{name}: {known.material}, K_tc {known.tangential_n_per_m2:.4g} N/m^2, K_rc/K_tc "
                f"{known.radial_ratio:.3g} ({known.source})"
            )
        write_json(
            json_path, {name: {**asdict(known), "kr_ratio": known.radial_ratio} for name, known in MATERIALS.items()}
        )
        return
    if case_path is None or depth_mm is None:
        refuse("a fit needs --case (tool and engagement that were cut) and --depth-mm")
    fit = fit_force_file(forces_path, load_stability_case(case_path), depth_mm)
    say(
        f"kt_n_per_m2: {fit.coefficients.tangential_n_per_m2:.4g}, kr_ratio: {fit.coefficients.radial_ratio:.4g} "
        f"(R^2 {fit.determination:.4f}, residual {fit.residual_rms_n:.3g} N)"
    )
    write_json(json_path, coefficients_content(fit))
