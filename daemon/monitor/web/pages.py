"""The pages: files of one folder, kept compressed in memory, each answered with its digest."""

import gzip
import hashlib
import mimetypes
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from starlette.requests import Request
from starlette.responses import Response

FOLDER = Path(__file__).parent.parent / "pages"
START = "index.html"
TYPES = {
    ".js": "text/javascript",
    ".html": "text/html",
    ".css": "text/css",
    ".svg": "image/svg+xml",
    ".md": "text/markdown",
}
COMPRESSED = frozenset({".js", ".html", ".css", ".svg", ".json", ".txt", ".md", ".webmanifest"})
MOST_KEPT = 4 << 20
"""A larger folder of pages is none of ours [byte]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Page:
    """One file as it is sent."""

    stamp: tuple[int, int]
    kind: str
    plain: bytes
    packed: bytes | None
    tag: str


class Pages:
    """The files of the folder; one that has changed is read again."""

    def __init__(self) -> None:
        self._pages: dict[str, Page] = {}

    def _page(self, name: str) -> Page | None:
        """Return a file of the folder by its name, None where there is none."""
        path = FOLDER / name
        if any(part in ("", ".", "..") for part in name.split("/")) or "\0" in name or "\\" in name:
            return None
        try:
            found = path.stat()
            stamp = (found.st_mtime_ns, found.st_size)
            known = self._pages.get(name)
            if known is not None and known.stamp == stamp:
                return known
            if not path.is_file() or found.st_size > MOST_KEPT or path.suffix == ".py":
                return None
            self._pages[name] = page = _read(path, stamp)
        except OSError:
            return None
        return page

    def answer(self, request: Request, name: str) -> Response | None:
        """Return the file of that name, or the page `name`.html; None where there is neither."""
        page = self._page(name or START) or ("." not in name and self._page(f"{name}.html")) or None
        if page is None:
            return None
        headers: dict[str, str] = {"etag": page.tag, "cache-control": "no-cache", "vary": "accept-encoding"}
        if request.headers.get("if-none-match") == page.tag:
            return Response(status_code=304, headers=headers)
        if page.packed is not None and takes_gzip(request.headers):
            return Response(page.packed, headers=headers | {"content-encoding": "gzip"}, media_type=page.kind)
        return Response(page.plain, headers=headers, media_type=page.kind)


def _read(path: Path, stamp: tuple[int, int]) -> Page:
    content = path.read_bytes()
    kind = TYPES.get(path.suffix) or mimetypes.guess_type(path.name)[0] or "application/octet-stream"
    packed = gzip.compress(content, 9, mtime=0) if path.suffix in COMPRESSED else None
    return Page(
        stamp=stamp, kind=kind, plain=content, packed=packed, tag=f'"{hashlib.sha256(content).hexdigest()[:24]}"'
    )


def takes_gzip(headers: Mapping[str, str]) -> bool:
    """Return whether the other side takes compressed answers."""
    return "gzip" in headers.get("accept-encoding", "")
