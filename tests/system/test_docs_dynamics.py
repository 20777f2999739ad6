"""What the documentation of spindle dynamics shows is true."""

from pathlib import Path

from render_spindle_file import spindle_reference

from config.machine.spindle import load_spindle
from config.machine.spindle_chain import build_spindle

DOCS = Path(__file__).parents[2] / "docs"


def code_blocks(page: str) -> list[str]:
    """Return the indented blocks of a page without their indent."""
    blocks, block = [], []
    for line in [*(DOCS / page).read_text("utf-8").splitlines(), ""]:
        if line.startswith("    "):
            block.append(line[4:])
        elif block:
            blocks.append("\n".join(block))
            block = []
    return blocks


def test_spindle_file_reference_is_current() -> None:
    assert (DOCS / "reference" / "spindle-file.md").read_text("utf-8") == spindle_reference(), "run `make docs`"


def test_the_direct_form_in_the_reference_is_valid(tmp_path: Path) -> None:
    (block,) = [each for each in code_blocks("reference/spindle-file.md") if "segments:" in each]
    file = tmp_path / "spindle.yaml"
    file.write_text(block)
    assert build_spindle(load_spindle(file), file).shaft.length_m > 0.2


def test_the_parts_in_the_guide_make_one_valid_spindle(tmp_path: Path) -> None:
    page = "how-to/from-impact-test-to-spindle-model.md"
    parts = [each for each in code_blocks(page) if each.startswith(("name:", "bearings:", "holder:"))]
    assert len(parts) == 3
    file = tmp_path / "spindle.yaml"
    file.write_text("\n".join(parts))
    spindle = build_spindle(load_spindle(file), file)
    assert len(spindle.shaft.supports) == 5
    assert len(spindle.holder) == 3
