"""The file of a thermomechanical model: versioned JSON with a checksum, never a pickle."""

from typing import Any

from models.model_file import ModelError, parse, record_from, text_of_file, unsigned
from models.thermomechanics.regression import AxisRegression, ThermomechanicalModel

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

    Raises ModelError naming source and key: not JSON, another format or version, missing or unknown keys, wrong types
    or shapes, numbers that are not finite, or a checksum that differs.

    `text`: content of the file. `source`: its name, for messages.
    """
    try:
        content = parse(text)
        if content.get("format") != FORMAT:
            raise ModelError("format", f"must be {FORMAT!r}; this is another kind of file")
        if content.get("format_version") != FORMAT_VERSION or isinstance(content.get("format_version"), bool):
            raise ModelError(
                "format_version", f"{content.get('format_version')!r} is unknown; this version reads {FORMAT_VERSION}"
            )
        bare = unsigned(content, "the fit")
        fields = {key: value for key, value in bare.items() if key not in ("format", "format_version")}
        axes = fields.get("axes")
        if not isinstance(axes, dict):
            raise ModelError("axes", "must be an object")
        fields["axes"] = {name: _axis_fields(name, each) for name, each in axes.items()}
        return record_from(fields, ThermomechanicalModel)
    except ModelError as error:
        raise ModelError(error.key, error.sentence, source) from error


def _axis_fields(name: str, told: Any) -> Any:
    """Return the fields of an `AxisRegression`, as far as what a file holds has their form."""
    if not isinstance(told, dict) or not isinstance(told.get("properties"), list):
        raise ModelError(f"axes.{name}", "must be an object with a list of properties")
    bounds = ("lowest", "highest")
    properties = [
        {key: value for key, value in each.items() if key not in bounds}
        | {"bounds": {key: each[key] for key in bounds if key in each}}
        for each in told["properties"]
        if isinstance(each, dict)
    ]
    return told | {"axis": name, "properties": properties}
