"""Reads and writes the JSON of model files, with sentences that name the key."""

import base64
import binascii
import hashlib
import json
import math
from typing import Any

import numpy as np

from models.records import FloatArray
from models.thermal.model import ModelError

LARGEST_NUMBER = 1e12
"""No quantity of a thermal model comes near this."""


def null_for_nan(value: Any) -> Any:
    """Return nested lists with None for NaN."""
    if isinstance(value, list):
        return [null_for_nan(item) for item in value]
    return None if isinstance(value, float) and math.isnan(value) else value


def compact(value: Any) -> str:
    """Return a value as JSON without spaces; numbers are exact."""
    return json.dumps(value, separators=(",", ":"), allow_nan=False, ensure_ascii=True)


def content_sha256(content: dict[str, Any]) -> str:
    """Return the checksum of the content of a file, whatever the order of its keys."""
    canonical = json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False, ensure_ascii=True)
    return hashlib.sha256(canonical.encode("ascii")).hexdigest()


def text_of_file(content: dict[str, Any]) -> str:
    """Return the content of a model file as its text: one key per line, the checksum last; numbers are exact."""
    lines = [f'"{key}": {compact(value)}' for key, value in content.items()]
    lines.append(f'"sha256": "{content_sha256(content)}"')
    return "{\n" + ",\n".join(lines) + "\n}\n"


def whole_content(text: str, version: int, keys: set[str], optional: frozenset[str] = frozenset()) -> dict[str, Any]:
    """Return what a model file holds, without its checksum.

    Parameters
    ----------
    text
        Content of the file.
    version
        The format version that is read.
    keys
        All other keys but the checksum.
    optional
        Those of them that may be missing.

    Raises
    ------
    ModelError
        Not JSON, another format version, missing or unknown keys, or a checksum that differs.

    """
    content = parse(text)
    found = content.get("format_version")
    if found != version or isinstance(found, bool):
        raise ModelError("format_version", f"{found!r} is unknown; this version of Toolpoint reads {version}")
    require_keys("", content, {"format_version", "sha256", *(keys - (optional - content.keys()))})
    if content.pop("sha256") != content_sha256(content):
        raise ModelError("sha256", "does not fit the content; the file was changed after training, train it again")
    return content


def parse(text: str) -> dict[str, Any]:
    """Return the object that a text holds; raises ModelError."""

    def no_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        """Return the object; raises ModelError when a key stands twice."""
        keys = [key for key, _ in pairs]
        if twice := sorted({key for key in keys if keys.count(key) > 1}):
            raise ModelError(twice[0], "is written twice")
        return dict(pairs)

    def refuse_constant(name: str) -> float:
        """Refuse NaN and infinities, which JSON does not know."""
        raise ModelError("", f"{name} is not a number that a model may hold")

    try:
        content = json.loads(text, object_pairs_hook=no_duplicates, parse_constant=refuse_constant)
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


def require_keys(path: str, content: dict[str, Any], wanted: set[str]) -> None:
    """Raise ModelError naming the first key that is missing or unknown."""
    prefix = f"{path}." if path else ""
    if missing := sorted(wanted - set(content)):
        raise ModelError(prefix + missing[0], "is missing")
    if unknown := sorted(set(content) - wanted):
        raise ModelError(prefix + unknown[0], "is not a key of this format")


def read_object(path: str, value: Any, keys: set[str]) -> dict[str, Any]:
    """Return an object with exactly these keys; raises ModelError."""
    if not isinstance(value, dict):
        raise ModelError(path, f"must be an object, not {value!r:.40}")
    require_keys(path, value, keys)
    return value


def read_list(key: str, value: Any) -> list[Any]:
    """Return a list; raises ModelError."""
    if not isinstance(value, list):
        raise ModelError(key, f"must be a list, not {value!r:.40}")
    return value


def read_text(key: str, value: Any) -> str:
    """Return a text; raises ModelError."""
    if not isinstance(value, str):
        raise ModelError(key, f"must be text, not {value!r:.40}")
    return value


def read_integer(key: str, value: Any) -> int:
    """Return a whole number; raises ModelError."""
    if not isinstance(value, int) or isinstance(value, bool):
        raise ModelError(key, f"must be a whole number, not {value!r:.40}")
    return value


def read_number(key: str, value: Any) -> float:
    """Return a finite number; raises ModelError."""
    if isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= LARGEST_NUMBER:
        return float(value)
    raise ModelError(key, f"must be a finite number, not {value!r:.40}")


def read_vector(key: str, value: Any, *, null_allowed: bool = False) -> FloatArray:
    """Return a list of finite numbers as an array, shape (n,); raises ModelError."""
    items = read_list(key, value)
    return np.array(
        [
            np.nan if item is None and null_allowed else read_number(f"{key}[{index}]", item)
            for index, item in enumerate(items)
        ],
        dtype=np.float64,
    )


def read_matrix(key: str, value: Any) -> FloatArray:
    """Return rows of the same length as an array, shape (n, m); raises ModelError."""
    rows = [read_vector(f"{key}[{index}]", row) for index, row in enumerate(read_list(key, value))]
    if not rows or len({len(row) for row in rows}) != 1:
        raise ModelError(key, "must be a list of rows of the same length, one per channel")
    return np.vstack(rows)


def packed(matrix: FloatArray) -> dict[str, Any]:
    """Return a matrix as its shape and the base64 text of its values in single precision, little-endian."""
    data = np.ascontiguousarray(matrix, dtype="<f4").tobytes()
    return {"shape": list(matrix.shape), "float32": base64.b64encode(data).decode("ascii")}


def read_packed(key: str, value: Any) -> FloatArray:
    """Return a matrix that `packed` wrote, shape (n, m); raises ModelError."""
    item = read_object(key, value, {"shape", "float32"})
    shape = [read_integer(f"{key}.shape", size) for size in read_list(f"{key}.shape", item["shape"])]
    try:
        data = base64.b64decode(read_text(f"{key}.float32", item["float32"]), validate=True)
    except binascii.Error as error:
        raise ModelError(f"{key}.float32", f"is not base64 ({error})") from error
    if len(shape) != 2 or min(shape) < 0 or len(data) != 4 * shape[0] * shape[1]:
        raise ModelError(key, f"holds {len(data)} bytes, which is no matrix of shape {shape}")
    return np.frombuffer(data, dtype="<f4").astype(np.float64).reshape(shape)
