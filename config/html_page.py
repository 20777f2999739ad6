"""HTML pages that hold all they need: headings, texts, tables and pictures; every text is escaped."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

TEMPLATE = Path(__file__).with_name("page.html")


@dataclass(frozen=True, slots=True, kw_only=True)
class Section:
    """A heading, a paragraph, a list, a table and a picture; each may be empty."""

    title: str = ""
    text: str = ""
    items: tuple[str, ...] = ()
    head: tuple[str, ...] = ()
    rows: tuple[tuple[Any, ...], ...] = ()
    """Cells are texts, or numbers of which four digits are shown; None is a dash."""
    kind: str = ""
    """Class of the table or paragraph, see the style in `page.html`."""
    picture: str = ""
    """HTML or SVG that the program itself has made; it is not escaped."""
    name: str = ""
    """By which a link finds the picture."""
    caption: str = ""


def html_page(title: str, sections: Iterable[Section], *, paper: bool = False) -> str:
    """Return a page; one for `paper` is as wide as a sheet and lets a browser run and load nothing."""
    from jinja2 import Environment

    environment = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True)
    environment.filters["cell"] = _cell
    template = environment.from_string(TEMPLATE.read_text(encoding="utf-8"))
    return template.render(title=title, sections=list(sections), paper=paper)


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
