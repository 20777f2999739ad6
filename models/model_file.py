"""Model files: versioned JSON with a checksum, never a pickle; pydantic makes frozen records of them and back.

A record says by the types of its fields what its file holds; arrays are of type `Numbers` or `Packed`. Whatever
is wrong with a file is said with its name, the key and a sentence.
"""

import base64
import binascii
import hashlib
import json
import math
import re
from typing import Annotated, Any, Generic, TypeVar

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, PlainSerializer, PlainValidator, TypeAdapter, ValidationError

from models.errors import RefusedInputError
from models.records import FloatArray

FORMAT_VERSION = 3
"""Version of the layout of a file with a header; older ones have the keys of the model beside the version."""
HEADER = re.compile(rb'\s*\{\s*"format_version"\s*:\s*3\s*,\s*"family"\s*:\s*"([a-z0-9_-]+)"\s*,')

UNSAID_WHEN_EMPTY = {"pivots_mm"}
"""Keys that a file has only where they say something: versions before know nothing of them."""


class ModelError(RefusedInputError, ValueError):
    """A model is refused; the text names the file, the key, what is wrong and what to do."""

    def __init__(self, key: str, sentence: str, source: str = "model") -> None:
        self.key = key
        self.sentence = sentence
        super().__init__(f"{source}: {key}: {sentence}" if key else f"{source}: {sentence}")


def _read_numbers(value: Any) -> FloatArray:
    """Return numbers, or rows of the same length, as an array; null becomes NaN."""
    if isinstance(value, np.ndarray):
        return value
    if not isinstance(value, list):
        raise ValueError(f"must be a list, not {value!r:.40}")
    rows = value if value and all(isinstance(row, list) for row in value) else [value]
    for row in rows:
        for item in row:
            if item is not None and (not isinstance(item, int | float) or isinstance(item, bool)):
                raise ValueError(f"must be finite numbers, not {item!r:.40}")
    try:
        return np.array(value, dtype=np.float64)
    except ValueError as error:
        raise ValueError("must be a list of numbers, or of rows of the same length") from error
    except OverflowError as error:
        raise ValueError("must be finite numbers") from error


def _read_packed(value: Any) -> npt.NDArray[np.floating[Any]]:
    """Return a matrix from its shape and the base64 text of its values; the text's bytes are kept, not copied."""
    if isinstance(value, np.ndarray):
        return value
    if not isinstance(value, dict) or set(value) != {"shape", "float32"}:
        raise ValueError("must be an object with shape and float32")
    shape = value["shape"]
    if not isinstance(shape, list) or len(shape) != 2 or not all(type(size) is int and size >= 0 for size in shape):
        raise ValueError(f"has no shape of a matrix: {shape!r:.40}")
    try:
        data = binascii.a2b_base64(value["float32"], strict_mode=True)
    except (binascii.Error, TypeError, ValueError) as error:
        raise ValueError(f"float32 is not base64 ({error})") from error
    if len(data) != 4 * shape[0] * shape[1]:
        raise ValueError(f"holds {len(data)} bytes, which is no matrix of shape {shape}")
    return np.frombuffer(data, dtype="<f4").reshape(shape)


def _packed(matrix: npt.NDArray[np.floating[Any]]) -> dict[str, Any]:
    data = np.ascontiguousarray(matrix, dtype="<f4").tobytes()
    return {"shape": list(matrix.shape), "float32": base64.b64encode(data).decode("ascii")}


def _without_nan(value: Any) -> Any:
    if isinstance(value, list):
        return [_without_nan(item) for item in value]
    return None if isinstance(value, float) and math.isnan(value) else value


Numbers = Annotated[FloatArray, PlainValidator(_read_numbers), PlainSerializer(lambda a: _without_nan(a.tolist()))]
"""A vector or matrix: lists of numbers in the file, which are exact; NaN is null there."""
Packed = Annotated[npt.NDArray[np.floating[Any]], PlainValidator(_read_packed), PlainSerializer(_packed)]
"""A large matrix: in single precision in the file, and in memory when it comes from one."""

Record = TypeVar("Record")


class WithHeader(BaseModel, Generic[Record]):
    """A whole file: what stands around the record of a model."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, protected_namespaces=())

    format_version: int
    family: str
    model: Record
    sha256: str


def compact(value: Any) -> str:
    """Return a value as JSON without spaces; numbers are exact."""
    return json.dumps(value, separators=(",", ":"), allow_nan=False, ensure_ascii=True)


def file_text(family: str, record: object) -> str:
    """Return the text of the file of a record: one key per line, and a checksum of all that stands before it.

    `family`: name of the family in whose registry its reader stands. `record`: a dataclass whose arrays are `Numbers`
    or `Packed`.
    """
    fields: dict[str, Any] = TypeAdapter(type(record)).dump_python(record)
    fields = {key: value for key, value in fields.items() if value or key not in UNSAID_WHEN_EMPTY}
    lines = ",\n".join(f'"{key}": {compact(value)}' for key, value in fields.items())
    text = f'{{\n"format_version": {FORMAT_VERSION},\n"family": "{family}",\n"model": {{\n{lines}\n}},\n'
    return f'{text}"sha256": "{hashlib.sha256(text.encode("ascii")).hexdigest()}"\n}}\n'


def family_of(content: bytes) -> str | None:
    """Return the family that a file's header names; None where there is no such header.

    Raises ModelError when the checksum does not fit what stands before it.
    """
    header = HEADER.match(content)
    if header is None:
        return None
    end = content.rfind(b'"sha256"')
    digest = hashlib.sha256(memoryview(content)[: max(end, 0)]).hexdigest()
    if re.fullmatch(rb'"sha256"\s*:\s*"%b"\s*\}\s*' % digest.encode(), content[end:] if end > 0 else b"") is None:
        from models.headless_file import parse  # noqa: PLC0415

        parse(content.decode("utf-8"))  # half a file is no JSON: that says more
        raise ModelError("sha256", "does not fit the content; the file was changed after training, train it again")
    return header[1].decode()


def record_of(content: bytes, record: type[Record]) -> Record:
    """Return the record that a file with a header holds; its checksum is `family_of`'s business.

    Raises ModelError naming the key: missing or unknown, of another type or shape, or refused by the record itself.
    """
    try:
        return WithHeader[record].model_validate_json(content).model  # type: ignore[valid-type]
    except ValidationError as error:
        raise as_model_error(error) from error


def as_model_error(error: ValidationError) -> ModelError:
    """Return the first thing that is wrong, in the words of a model file."""
    first = error.errors(include_url=False)[0]
    cause = first.get("ctx", {}).get("error")
    path = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in first["loc"][1:])
    key, sentence = path.lstrip("."), first["msg"].removeprefix("Value error, ")
    if isinstance(cause, ModelError):
        return ModelError(cause.key, cause.sentence)
    known = {
        "missing": "is missing",
        "unexpected_keyword_argument": "is not a key of this format",
        "extra_forbidden": "is not a key of this format",
        "string_type": f"must be text, not {first['input']!r:.40}",
        "int_type": f"must be a whole number, not {first['input']!r:.40}",
        "tuple_type": f"must be a list, not {first['input']!r:.40}",
        "dataclass_type": f"must be an object, not {first['input']!r:.40}",
        "float_type": f"must be a finite number, not {first['input']!r:.40}",
        "finite_number": f"must be a finite number, not {first['input']!r:.40}",
    }
    return ModelError(key, known.get(first["type"], sentence))
