"""Common base of all configuration sections."""

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field


class Section(BaseModel):
    """A configuration section: unknown keys are refused, types are strict, values are frozen."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


Seconds = Annotated[float, Field(gt=0)]
Days = Annotated[float, Field(gt=0)]
MacroNumber = Annotated[int, Field(ge=1, le=99999)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*$", max_length=40)]
