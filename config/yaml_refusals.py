"""What is said of a text that is no YAML, in place of the parser's words, and how a refusal names a value."""

import re
from typing import Any

import yaml

SENTENCES = {
    r"found character '\\t'.*": "a tab may not stand here; indent with blanks",
    "mapping values are not allowed here": "a key may not stand here: the line above lacks its colon, or this line is "
    "indented otherwise than its neighbours; a text with a colon and a blank in it needs quotes",
    "could not find expected ':'": "a key must stand here, and its colon is missing; or a line above has a quote or a "
    "bracket that does not end",
    r"expected <block end>, but found '(<block .*|<scalar>|-)'": "this line is indented otherwise than the lines of "
    "its section",
    r"expected ',' or '[]}]', but got .*": "the list or mapping in brackets that begins {where} does not end before "
    "this, or lacks a comma",
    "found unexpected end of stream": "the quote that begins {where} does not end",
    r"found undefined alias .*": "a text that begins with * needs quotes",
    r"found character '(.)' that cannot start any token": r"a text that begins with \1 needs quotes",
    "but found another document": "a second document begins here, and the file may hold one; remove the line ---",
}
"""What the parser says -> what a person is told; `{where}`: where that began of which the parser speaks."""


def sentence_of(error: yaml.MarkedYAMLError) -> str:
    """Return what is wrong and what to do."""
    begun = error.context_mark
    where = "above" if begun is None else f"in line {begun.line + 1}"
    for pattern, sentence in SENTENCES.items():
        if match := re.fullmatch(pattern, error.problem or ""):
            return match.expand(sentence.replace("{where}", where))
    return f"this is not valid YAML: {error.problem}" + (f" ({error.context})" if error.context else "")


_CREDENTIALS = re.compile(
    r"""(?i)(?P<before>://)[^'"`\n]*@|[^\s'"`/:]+:(?!//)[^\s'"`]*@"""
    r"""|(?P<named>\w*(?:passw|pwd|secret|token|api_?key)\w*\s*=\s*)(?:'[^']*'?|"[^"]*"?|[^\s&'"`]+)"""
)
LONGEST_SHOWN = 60


def without_credentials(text: str) -> str:
    """Return a text with stars for who logs in and by what, as an address or a connection string holds it."""
    return _CREDENTIALS.sub(
        lambda found: f"{found['before'] or found['named'] or ''}***{'' if found['named'] else '@'}", text
    )


def described(value: Any) -> str:
    """Return a value as a sentence names it."""
    if value is None:
        return "nothing"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        hidden = without_credentials(value)
        shown = hidden if len(hidden) <= LONGEST_SHOWN else hidden[: LONGEST_SHOWN - 3] + "..."
        return f"the text {shown!r}" if value else "empty text"
    if isinstance(value, dict):
        return "keys with values" if value else "an empty mapping"
    if isinstance(value, list):
        return "a list" if value else "an empty list"
    return f"{value}"
