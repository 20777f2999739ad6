"""Text from outside: what is printable stays, everything else becomes its escape."""

from hypothesis import given
from hypothesis import strategies as st

from models.json_values import all_printable, printable


@given(st.text(st.characters(codec=None)))
def test_any_text_can_be_encoded_and_printed(text: str) -> None:
    shown = printable(text)
    assert shown.isprintable()
    shown.encode("utf-8")
    assert printable(shown) == shown


def test_every_text_of_a_json_value_is_made_printable() -> None:
    assert all_printable({"a\x00": ["\ud800", 1, None, {"b": True}]}) == {"a\\x00": ["\\ud800", 1, None, {"b": True}]}
