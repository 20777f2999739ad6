"""Common base of all configuration sections, and what is said when a file is refused."""

from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import wraps
from typing import Annotated, Any, ClassVar, TypeVar, get_args

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from models.errors import RefusedInputError
from models.json_values import printable

KeyPath = tuple[str | int, ...]
Value = TypeVar("Value", bound=Hashable)


class Section(BaseModel):
    """A configuration section: unknown keys are refused, types are strict, values are frozen."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False, defer_build=True)
    shipped: ClassVar[Mapping[str, str]] = {}
    """Keys whose paths may be bare names of YAML files that ship -> the folder of this package where they lie."""


Problems = Iterator[tuple[KeyPath, str]]
"""What a section's own check refuses: the keys that it means (paths relative to the section), and why."""


class KeyProblems(ValueError):
    """What `checked` raises."""

    def __init__(self, problems: Sequence[tuple[KeyPath, str]]) -> None:
        self.problems = tuple(problems)
        super().__init__("; ".join(sentence for _, sentence in self.problems))


def checked(found: Callable[[Any], Problems]) -> Any:
    """Make of a method that yields what is wrong with a section the validator that refuses it."""

    @wraps(found)
    def refuse(section: Any) -> Any:
        if problems := list(found(section)):
            raise KeyProblems(problems)
        return section

    return model_validator(mode="after")(refuse)


def repeated(values: Iterable[Value]) -> Iterator[tuple[int, Value]]:
    """Yield the place and the value of each that was there before."""
    seen: set[Value] = set()
    for place, value in enumerate(values):
        if value in seen:
            yield place, value
        seen.add(value)


def first_fault(error: ValidationError) -> str:
    """Return the key of a record that is wrong first, and why."""
    fault = error.errors(include_url=False)[0]
    where, why = ".".join(map(str, fault["loc"])), fault["msg"].removeprefix("Value error, ")
    return f"{where}: {why}" if where else why


NAME_PATTERN = r"^[A-Za-z][A-Za-z0-9_]*$"
AXIS_PATTERN = r"^[A-Z][0-9]?$"
CHANNEL_PATTERN = r"^\S([^\x00-\x1f\x7f]*\S)?$"
RANGE_PATTERN = r"^\d+-\d+$"
NUMBER_OR_RANGE_PATTERN = r"^\d+(-\d+)?$"
READ_AHEAD_STOP_PATTERN = r"^(G53|M[1-9]\d{0,2})$"
TOPIC_PATTERN = r"^[^+#\x00]+$"
TOPIC_LEVEL_PATTERN = r"^[^/+#\x00-\x1f\x7f]+$"
HOST_PATTERN = r"^([^\x00-\x20\x7f/@:\[\]]+|[0-9A-Fa-f]*:[0-9A-Fa-f:.]*:[^\x00-\x20\x7f/@\[\]]*)$"
SERVER_PATTERN = rf"^[/@][^\x00-\x1f\x7f]*$|{HOST_PATTERN}"
ENDPOINT_PATTERN = r"^opc\.tcp://[^\x00-\x20\x7f/]+(/[^\x00-\x1f\x7f]*)?$"
AGENT_PATTERN = r"^http://[^\x00-\x20\x7f/?#@]+(/[^\x00-\x20\x7f?#]*)?$"
FOLDER_OR_BUCKET_PATTERN = r"^(/|(s3|gs)://[^\s/])"
WEBHOOK_PATTERN = r"^https?://[!-.0->A-~]+([/?][!-~]*)?$"
MAIL_ADDRESS_PATTERN = r"^[A-Za-z0-9.!#$%&'*+/=?^_`{|}~-]+@[A-Za-z0-9.-]+$"

Seconds = Annotated[float, Field(ge=0.001, le=31_536_000)]
Days = Annotated[float, Field(gt=0, le=36_500)]
MacroNumber = Annotated[int, Field(ge=1, le=99999)]
Host = Annotated[str, Field(pattern=HOST_PATTERN, max_length=253)]
"""Where a link goes, or what is listened on."""
Name = Annotated[str, Field(pattern=NAME_PATTERN, max_length=40)]
MachineName = Annotated[str, Field(pattern=CHANNEL_PATTERN, max_length=200)]
ChannelName = Annotated[str, Field(pattern=CHANNEL_PATTERN, max_length=80)]
"""A displacement channel is called what the column of its recording is: `Weg Z [um]`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Problem:
    """One thing that is wrong in a file. Lines and columns count from 1; 0 stands for the file as a whole."""

    file: str
    line: int
    column: int
    key: str
    """Path of the key, such as `cnc.macros.values.y`; empty for the file as a whole."""
    sentence: str
    """What was refused, why, and what the person can do."""

    def __str__(self) -> str:
        """Return `file:line:column: key.path: sentence`, without what is not known."""
        place = f"{self.file}:{self.line}:{self.column}" if self.line else self.file
        return printable(f"{place}: {self.key}: {self.sentence}" if self.key else f"{place}: {self.sentence}")


class ConfigurationError(RefusedInputError):
    """A configuration file is refused; `problems` holds everything that is wrong, sorted by position."""

    def __init__(self, problems: Iterable[Problem]) -> None:
        self.problems = tuple(sorted(problems, key=lambda problem: (problem.line, problem.column, problem.key)))
        super().__init__("\n".join(str(problem) for problem in self.problems))


def section_of_driver(schema: dict[str, Any], model: type[BaseModel]) -> None:
    """Tell JSON Schema that the driver needs its own section and takes no other."""
    drivers = drivers_of(model)
    schema["allOf"] = [
        {
            "if": {"properties": {"driver": {"const": driver}}, "required": [] if driver == drivers[0] else ["driver"]},
            "then": {
                "required": [driver],
                "properties": {driver: {"type": "object"}}
                | {other: {"type": "null"} for other in drivers if other != driver},
            },
        }
        for driver in drivers
    ]


def drivers_of(model: type[BaseModel]) -> tuple[str, ...]:
    """Return the names that `driver` may have, the default first."""
    return get_args(model.model_fields["driver"].annotation)


class SectionOfDriver(Section):
    """A union that the field `driver` decides, with one key per driver."""

    model_config = ConfigDict(json_schema_extra=section_of_driver)

    @checked
    def _only_the_section_of_the_driver(self) -> Problems:
        chosen = getattr(self, "driver")  # noqa: B009 - the field is that of the subclass
        for driver in drivers_of(type(self)):
            given = getattr(self, driver) is not None
            if driver == chosen and not given:
                description = type(self).model_fields[driver].description
                yield (driver,), f"this key is required and missing: {description}"
            elif driver != chosen and given:
                sentence = f"this section is for driver {driver}, but driver is {chosen}: keep one of the two"
                yield (driver,), sentence


class TlsAccount(Section):
    """What is checked of every section with an account at a server that is reached with TLS or without."""

    @checked
    def _of_use(self) -> Problems:
        given = dict(self)
        if given["password_file"] is not None and given["user_name"] is None:
            yield ("user_name",), "a password needs a user name"
        elif given["ca_certificate"] is not None and not given["tls"]:
            yield ("tls",), "ca_certificate is of use with `tls: true` only"
