"""What tables have in common that people export: the mark between fields, the decimal mark, the names in the header."""

import csv

DELIMITERS = (",", ";", "\t")


def columns(header: str) -> tuple[list[str], str]:
    """Return the names of a table's columns, in lower case, and what separates its fields; raises csv.Error."""
    delimiter = max(DELIMITERS, key=header.count)
    return [name.strip().lower() for name in next(csv.reader([header], delimiter=delimiter), [])], delimiter


def number(text: str, delimiter: str) -> float:
    """Return a field as a number, which may have a decimal comma where no comma separates fields; raises ValueError."""
    return float(text if delimiter == "," else text.replace(",", "."))
