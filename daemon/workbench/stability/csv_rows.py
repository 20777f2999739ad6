"""The rows of a CSV file that a person exported."""

import csv
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from models.errors import StabilityError


@contextmanager
def csv_rows(path: Path, what: str) -> Iterator["csv.DictReader[str]"]:
    """Open a file whose header names its columns; raises StabilityError when it cannot be read as text."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.DictReader(file)
            reader.fieldnames = [name.strip() for name in reader.fieldnames or []]
            yield reader
    except OSError as error:
        raise StabilityError(f"{path}: cannot be opened ({error.strerror})") from error
    except csv.Error as error:
        raise StabilityError(f"{path}: is not CSV ({error})") from error
    except UnicodeDecodeError as error:
        raise StabilityError(f"{path}: is not UTF-8 text; export the {what} as CSV") from error
