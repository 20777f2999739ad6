"""Why something may not be done, as a typed reason."""

from dataclasses import dataclass
from enum import StrEnum


class InhibitCode(StrEnum):
    """What inhibits switching an axis on, following the estimate, or writing at all."""

    NOT_BEGUN = "not begun"
    CLOCK = "clock"
    CONTROL = "control"
    COMMISSIONING = "commissioning"
    SECURITY = "security"
    UNKNOWN_AXIS = "unknown axis"
    MODEL = "model"
    OUTAGE = "outage"
    HARM = "harm"
    LINK = "link"
    ECHO = "echo"
    REFERENCE = "reference"
    STALE = "stale"
    CONFIDENCE = "confidence"
    DOMAIN = "domain"
    NO_ESTIMATE = "no estimate"
    PROBE = "probe"
    FAULT = "fault"


@dataclass(frozen=True, slots=True, kw_only=True)
class Inhibit:
    """One reason, and what a person can do about it."""

    code: InhibitCode
    text: str
    remedy: str = ""

    def __str__(self) -> str:
        return f"{self.text}; {self.remedy}" if self.remedy else self.text
