"""Reads passwords and other secrets from the files that the configuration names."""

from pathlib import Path

from config.files import read_closed

LONGEST_SECRET = 8192


class SecretError(Exception):
    """A file that the configuration names cannot be used; the text names key and file, and nothing of its content."""


def read_secret(key: str, path: Path) -> str:
    """Return the one line of a file, blanks with it: a password may begin or end with one. Raises SecretError."""
    try:
        text = read_closed(path).decode("utf-8-sig").rstrip("\r\n")
    except (OSError, UnicodeDecodeError) as error:
        why = error.strerror if isinstance(error, OSError) else "it is no text"
        raise SecretError(
            f"`{key}` {path} cannot be read ({why}): check the path, and that the service may read it"
        ) from None
    if text.splitlines() != [text] or "\0" in text or len(text) > LONGEST_SECRET:
        raise SecretError(f"`{key}` {path} must hold one line of text: write it anew")
    return text
