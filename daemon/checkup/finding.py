"""What was tried, and what came of it."""

from dataclasses import dataclass

import click

from models.json_values import printable


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """One thing that was tried."""

    subject: str
    passed: bool
    detail: str
    pending: bool = False
    """Not passed because it is not set up yet: the configuration does not name it, the daemon is to make it, or a
    person is to release it."""

    @property
    def failed(self) -> bool:
        """Something that is there, or should be, is not as it should be."""
        return not self.passed and not self.pending

    def as_json(self) -> dict[str, str | bool]:
        """Return what stands in the JSON output."""
        return {"subject": self.subject, "passed": self.passed, "pending": self.pending, "detail": self.detail}


def show_finding(finding: Finding) -> None:
    """Print one line of what was tried."""
    mark, colour = ("ok", "green") if finding.passed else ("not yet", "yellow") if finding.pending else ("FAIL", "red")
    click.echo(f"{click.style(f'{mark:7}', fg=colour)}  {finding.subject}: {printable(finding.detail)}")
