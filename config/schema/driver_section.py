"""Sections of the configuration of which `driver` says which other section is read."""

from typing import Any, Self, get_args

from pydantic import BaseModel, ConfigDict, model_validator

from config.schema.base import KeyPath, KeyProblems, Section


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

    @model_validator(mode="after")
    def _only_the_section_of_the_driver(self) -> Self:
        problems: list[tuple[KeyPath, str]] = []
        chosen = getattr(self, "driver")  # noqa: B009 - the field is that of the subclass
        for driver in drivers_of(type(self)):
            given = getattr(self, driver) is not None
            if driver == chosen and not given:
                description = type(self).model_fields[driver].description
                problems.append(((driver,), f"this key is required and missing: {description}"))
            elif driver != chosen and given:
                sentence = f"this section is for driver {driver}, but driver is {chosen}: keep one of the two"
                problems.append(((driver,), sentence))
        if problems:
            raise KeyProblems(problems)
        return self
