"""The page of the messages knows every sentence that an operator may read, and no other."""

from pathlib import Path

import render_messages as render

ROOT = Path(__file__).parents[2]
REFERENCE = ROOT / "docs" / "reference"


def test_every_sentence_has_its_cause_and_what_to_do():
    made, wrong = render.page(render.entries())
    assert not wrong, "write cause and remedy into docs/reference/messages.yaml: " + "; ".join(wrong)
    assert (REFERENCE / "messages.md").read_text(encoding="utf-8") == made, "run `make docs`"


def test_a_new_sentence_and_one_that_is_gone_are_found(tmp_path):
    module = tmp_path / "module.py"
    module.write_text(
        '"""What it does is no message."""\n'
        "def check(axis: str, value: float) -> str:\n"
        '    """Return what is wrong."""\n'
        "    if value < 0:\n"
        '        raise ValueError("value must not be negative")\n'
        '    return f"axis {axis} stands still: look at the drive" if value else "two words"\n',
        encoding="utf-8",
    )
    assert render.messages(module) == ["axis … stands still: look at the drive"]
    known = render.entries()
    del known["the CNC's echo is vacant"]
    _, wrong = render.page({**known, "nobody says this": {"cause": "none", "do": "nothing"}})
    assert len(wrong) == 2 and "the CNC's echo is vacant" in wrong[0] and "nobody says this" in wrong[1]
