"""What is wrong with a record that was read from a file, in one sentence."""

from pydantic import ValidationError


def first_fault(error: ValidationError) -> str:
    """Return the key that is wrong first, and why."""
    fault = error.errors(include_url=False)[0]
    where = ".".join(map(str, fault["loc"]))
    why = fault["msg"].removeprefix("Value error, ")
    return f"{where}: {why}" if where else why
