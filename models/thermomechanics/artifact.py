"""The file of a thermomechanical model: versioned JSON with a checksum, never a pickle."""

from typing import Any

import numpy as np

from models.thermal.json_fields import (
    content_sha256,
    parse,
    read_list,
    read_number,
    read_object,
    read_text,
    read_vector,
    require_keys,
    text_of_file,
)
from models.thermal.model import ModelError
from models.thermomechanics.regression import (
    AxisRegression,
    Bounds,
    FittedRange,
    PropertyRegression,
    ThermomechanicalModel,
)

FORMAT = "toolpoint-thermomechanics"
FORMAT_VERSION = 1
"""Version of the file's layout; another one is refused."""
_TEXTS = ("model_id", "source", "created", "rigid_rotary_inertia", "spindle_sha256")


def model_to_json(model: ThermomechanicalModel) -> str:
    """Return the model as the text of its file, one key per line; numbers are exact."""
    content: dict[str, Any] = {"format": FORMAT, "format_version": FORMAT_VERSION}
    content |= {name: getattr(model, name) for name in _TEXTS}
    content |= {"training": list(model.training), "axes": {name: _axis(each) for name, each in model.axes.items()}}
    return text_of_file(content)


def _axis(axis: AxisRegression) -> dict[str, Any]:
    seen = axis.fitted_range
    return {
        "signals": list(axis.signals),
        "fitted_range": None
        if seen is None
        else {"lowest_degc": seen.lowest_degc.tolist(), "highest_degc": seen.highest_degc.tolist()},
        "fixed": dict(axis.fixed),
        "properties": [
            {
                "name": each.name,
                "interval_min": each.interval_min,
                "coefficients": each.coefficients.tolist(),
                "lowest": each.bounds.lowest,
                "highest": each.bounds.highest,
                "deviation": each.deviation,
            }
            for each in axis.properties
        ],
    }


def model_from_json(text: str, source: str) -> ThermomechanicalModel:
    """Return the model that a file holds.

    Parameters
    ----------
    text
        Content of the file.
    source
        Its name, for messages.

    Raises
    ------
    ModelError
        Naming source and key: not JSON, another format or version, missing or unknown keys, wrong types or shapes,
        numbers that are not finite, or a checksum that differs.

    """
    try:
        content = parse(text)
        if content.get("format") != FORMAT:
            raise ModelError("format", f"must be {FORMAT!r}; this is another kind of file")
        if content.get("format_version") != FORMAT_VERSION or isinstance(content.get("format_version"), bool):
            raise ModelError(
                "format_version", f"{content.get('format_version')!r} is unknown; this version reads {FORMAT_VERSION}"
            )
        require_keys("", content, {"format", "format_version", *_TEXTS, "training", "axes", "sha256"})
        if content.pop("sha256") != content_sha256(content):
            raise ModelError("sha256", "does not fit the content; the file was changed after the fit, fit it again")
        axes = content["axes"]
        if not isinstance(axes, dict):
            raise ModelError("axes", "must be an object")
        return ThermomechanicalModel(
            **{name: read_text(name, content[name]) for name in _TEXTS},
            training=tuple(read_text("training", each) for each in read_list("training", content["training"])),
            axes={name: _read_axis(name, each) for name, each in axes.items()},
        )
    except ModelError as error:
        raise ModelError(error.key, error.sentence, source) from error


def _read_axis(name: str, told: Any) -> AxisRegression:
    path = f"axes.{name}"
    item = read_object(path, told, {"signals", "fitted_range", "fixed", "properties"})
    signals = tuple(read_text(f"{path}.signals", each) for each in read_list(f"{path}.signals", item["signals"]))
    fixed = item["fixed"]
    if not isinstance(fixed, dict):
        raise ModelError(f"{path}.fixed", "must be an object")
    properties = read_list(f"{path}.properties", item["properties"])
    return AxisRegression(
        axis=name,
        signals=signals,
        properties=tuple(_read_property(f"{path}.properties[{k}]", each) for k, each in enumerate(properties)),
        fixed={key: read_number(f"{path}.fixed.{key}", value) for key, value in fixed.items()},
        fitted_range=_read_range(f"{path}.fitted_range", item["fitted_range"], len(signals)),
    )


def _read_range(path: str, told: Any, count: int) -> FittedRange | None:
    if told is None:
        return None
    item = read_object(path, told, {"lowest_degc", "highest_degc"})
    low, high = (read_vector(f"{path}.{name}", item[name]) for name in ("lowest_degc", "highest_degc"))
    if low.shape != (count,) or high.shape != (count,) or bool(np.any(low > high)):
        raise ModelError(path, f"needs {count} ascending pairs, one for each signal")
    return FittedRange(lowest_degc=low, highest_degc=high)


def _read_property(path: str, told: Any) -> PropertyRegression:
    item = read_object(path, told, {"name", "interval_min", "coefficients", "lowest", "highest", "deviation"})
    deviation = item["deviation"]
    return PropertyRegression(
        name=read_text(f"{path}.name", item["name"]),
        interval_min=read_number(f"{path}.interval_min", item["interval_min"]),
        coefficients=read_vector(f"{path}.coefficients", item["coefficients"]),
        bounds=Bounds(
            lowest=read_number(f"{path}.lowest", item["lowest"]),
            highest=read_number(f"{path}.highest", item["highest"]),
        ),
        deviation=None if deviation is None else read_number(f"{path}.deviation", deviation),
    )
