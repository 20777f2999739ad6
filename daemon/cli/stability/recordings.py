"""`toolpoint stability chatter` and `roughness`: what recordings of a cut say."""

import math
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from daemon.cli.common import FILE, option, refuse, say, write_json
from daemon.cli.options import POSITIVE, FiniteFloat, json_option, picture_option

if TYPE_CHECKING:
    from daemon.workbench.stability.recordings import Passage

SCALE = FiniteFloat(min=1e-6, max=1e6)


def _passages(ctx: click.Context, param: click.Parameter, value: tuple[str, ...]) -> "tuple[Passage, ...]":
    from daemon.workbench.stability.recordings import Passage

    found = []
    for text in value:
        try:
            from_s, to_s, depth_mm = (float(number) for number in text.split(":"))
        except ValueError:
            raise click.BadParameter(f"{text!r} is no passage such as 1.5:4:6 (from s, to s, depth in mm)") from None
        if not (all(map(math.isfinite, (from_s, to_s, depth_mm))) and from_s < to_s and depth_mm > 0.0):
            raise click.BadParameter(f"{text!r}: the passage must end after it begins, at a depth above 0 mm")
        found.append(Passage(from_s=from_s, to_s=to_s, depth_mm=depth_mm))
    return tuple(found)


@click.command()
@click.argument("recording_path", metavar="RECORDING", type=FILE)
@option("--speed-rpm", type=POSITIVE, required=True, help="Spindle speed [1/min], to within 3 %.")
@option("--teeth", type=click.IntRange(1, 100), required=True, help="Number of teeth.")
@option(
    "--passage",
    "passages",
    metavar="FROM_S:TO_S:DEPTH_MM",
    multiple=True,
    callback=_passages,
    help="A part of the recording cut at one depth (may be repeated); without, the whole is judged.",
)
@option(
    "--idle",
    "idle_path",
    metavar="RECORDING",
    type=FILE,
    help="The same sensor while the spindle turns without a cut: what the machine has there is not taken for chatter.",
)
@option("--full-scale-m-s2", type=SCALE, help="What full scale of a WAV file means [m/s^2].")
@picture_option
@json_option
def chatter(
    recording_path: Path,
    speed_rpm: float,
    teeth: int,
    passages: "tuple[Passage, ...]",
    idle_path: Path | None,
    full_scale_m_s2: float | None,
    picture: Path | None,
    json_path: str | None,
) -> None:
    """Look for chatter in the accelerometer RECORDING (WAV, or CSV with time_s,acceleration_m_s2)."""
    from daemon.workbench.stability.recordings import judge_recording
    from drivers.files.accelerometer_recording import read_acceleration
    from models.errors import StabilityError

    try:
        recording = read_acceleration(recording_path, full_scale_m_s2)
        idle = None if idle_path is None else read_acceleration(idle_path, full_scale_m_s2)
        content = judge_recording(recording, speed_rpm, teeth, passages, idle)
    except StabilityError as error:
        refuse(f"{recording_path}: {error}")
    for part in content.get("depths", [content]):
        _show(part)
    for warning in content["warnings"]:
        say(warning)
    if picture is not None:
        from daemon.workbench.stability.pictures import spectrogram_picture
        from models.stability.spectra import short_time_spectra

        spectrogram_picture(
            picture,
            short_time_spectra(recording.acceleration_m_s2, recording.sample_rate_hz),
            offset_s=recording.start_s,
            tooth_passing_hz=content["tooth_passing_hz"],
            chatter_hz=content["frequency_hz"],
            title=recording_path.name,
        )
    write_json(json_path, content)


def _show(part: dict[str, Any]) -> None:
    place = f"{part['depth_mm']:g} mm: " if "depth_mm" in part else ""
    if part["chatter"]:
        words = f"chatter at {part['frequency_hz']:.1f} Hz from {part['onset_s']:.2f} s on"
    else:
        words = "no chatter"
    say(f"{place}{words} (teeth pass at {part['tooth_passing_hz']:.1f} Hz)")


@click.command()
@click.argument("profile_path", metavar="PROFILE.csv", type=FILE)
@option("--cutoff-mm", type=POSITIVE, help="Cut-off of the Gaussian filter [mm]; without, the mean line only.")
@picture_option
@json_option
def roughness(profile_path: Path, cutoff_mm: float | None, picture: Path | None, json_path: str | None) -> None:
    """Roughness per depth of cut from a surface PROFILE (CSV with position_mm,height_um and, if any, depth_mm)."""
    from daemon.workbench.stability.recordings import read_profile
    from models.errors import StabilityError
    from models.stability.roughness import roughness_per_depth

    table, with_depths = read_profile(profile_path)
    try:
        found = roughness_per_depth(table[:, 2], table[:, 0], table[:, 1], cutoff_mm)
    except StabilityError as error:
        refuse(f"{profile_path}: {error}")
    names = {depth: f"{depth:g} mm" if with_depths else "" for depth in found}
    for depth, each in found.items():
        say(f"{names[depth]}: ".lstrip(": ") + f"Ra {each.ra_um:.3g} um, Rz {each.rz_um:.3g} um")
    if picture is not None:
        from daemon.workbench.stability.pictures import profile_picture

        parts = [(name, table[table[:, 2] == depth, :2]) for depth, name in names.items()]
        profile_picture(picture, parts, title=profile_path.name)
    depths = [{"depth_mm": depth if with_depths else None, **asdict(each)} for depth, each in found.items()]
    write_json(json_path, {"depths": depths})
