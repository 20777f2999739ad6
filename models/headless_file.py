"""Model files without a header, and what any text is that is no model file: the daemon reads them only where one is."""

import hashlib
import json
import math
from typing import Any

from pydantic import ValidationError

from models.model_file import FORMAT_VERSION, ModelError, Record, WithHeader, as_model_error, compact


def record_from(fields: dict[str, Any], record: type[Record]) -> Record:
    """Return the record of the keys and values of a file without a header; raises ModelError as `record_of`."""
    whole = {"format_version": FORMAT_VERSION, "family": "", "model": fields, "sha256": ""}
    try:
        return WithHeader[record].model_validate(whole, strict=False).model  # type: ignore[valid-type]
    except ValidationError as error:
        raise as_model_error(error) from error


def content_sha256(content: dict[str, Any]) -> str:
    """Return the checksum of the content of a file without a header, whatever the order of its keys."""
    canonical = json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False, ensure_ascii=True)
    return hashlib.sha256(canonical.encode("ascii")).hexdigest()


def text_of_file(content: dict[str, Any]) -> str:
    """Return a file without a header as its text: one key per line, the checksum last; numbers are exact."""
    lines = [f'"{key}": {compact(value)}' for key, value in content.items()]
    lines.append(f'"sha256": "{content_sha256(content)}"')
    return "{\n" + ",\n".join(lines) + "\n}\n"


def unsigned(content: dict[str, Any], made_by: str) -> dict[str, Any]:
    """Return the content of a file without a header, without its checksum; raises ModelError when that differs.

    `content`: as `parse` gave it. `made_by`: what made the file, and would have to make it again: `training`, `the
    fit`.
    """
    if "sha256" not in content:
        raise ModelError("sha256", "is missing")
    bare = {key: value for key, value in content.items() if key != "sha256"}
    if content["sha256"] != content_sha256(bare):
        again = "train it again" if made_by == "training" else "fit it again"
        raise ModelError("sha256", f"does not fit the content; the file was changed after {made_by}, {again}")
    return bare


def parse(text: str) -> dict[str, Any]:
    """Return the object that a text holds; raises ModelError."""

    def no_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        """Return the object; raises ModelError when a key stands twice."""
        found = dict(pairs)
        if len(found) != len(pairs):
            keys = [key for key, _ in pairs]
            raise ModelError(next(key for key in keys if keys.count(key) > 1), "is written twice")
        return found

    def finite(number: str) -> float:
        """Return the number; raises ModelError for NaN, for infinities and for one that is too large, such as 1e999."""
        if math.isfinite(value := float(number)):
            return value
        raise ModelError("", f"{number[:40]} is not a number that a model may hold")

    try:
        content = json.loads(text, object_pairs_hook=no_duplicates, parse_constant=finite, parse_float=finite)
    except json.JSONDecodeError as error:
        sentence = f"line {error.lineno}, column {error.colno}: this is not JSON ({error.msg}); is the file whole?"
        raise ModelError("", sentence) from error
    except ModelError:
        raise
    except ValueError as error:
        raise ModelError("", f"holds a number that cannot be read ({error})") from error
    except RecursionError as error:
        raise ModelError("", "is nested too deeply to be a model") from error
    if not isinstance(content, dict):
        raise ModelError("", "is no JSON object; this is not a model file")
    return content
