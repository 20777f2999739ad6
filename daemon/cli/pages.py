"""Results as a page: the option, and writing it."""

from pathlib import Path

from daemon.cli.common import FILE, option, refuse, say
from daemon.cli.options import writable

html_option = option(
    "--html",
    "html_path",
    metavar="FILE",
    type=FILE,
    callback=writable(),
    help="Draw the result as a page to zoom into, complete in one file.",
)


def write_page(path: Path, page: str) -> None:
    """Write a page, or end with why it cannot be written."""
    try:
        path.write_text(page, encoding="utf-8")
    except OSError as error:
        refuse(f"{path}: the page cannot be written ({error.strerror})")
    say(f"{path}: to look at in a browser")
