"""The file of a thermomechanical model: versioned JSON with a checksum, never a pickle."""

from typing import Any

from pydantic import TypeAdapter

from models.headless_file import parse, record_from, text_of_file, unsigned
from models.model_file import ModelError
from models.thermomechanics.regression import ThermomechanicalModel

FORMAT = "toolpoint-thermomechanics"
FORMAT_VERSION = 1
"""Version of the file's layout; another one is refused."""


def model_to_json(model: ThermomechanicalModel) -> str:
    """Return the model as the text of its file, one key per line; numbers are exact."""
    fields: dict[str, Any] = TypeAdapter(ThermomechanicalModel).dump_python(model)
    for axis in fields["axes"].values():
        del axis["axis"]  # the key says it
        axis["properties"] = [each | each.pop("bounds") for each in axis["properties"]]
    return text_of_file({"format": FORMAT, "format_version": FORMAT_VERSION} | fields)


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
