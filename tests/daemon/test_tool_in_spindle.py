"""What the expansion of a tool counts from when sensors of its term are away as it comes into the spindle."""

from dataclasses import replace
from types import SimpleNamespace

import pytest

from daemon.compensation.tool import ToolInSpindle
from models.control.reference_records import ToolOrigin


class Taken:
    """Takes what the references are told."""

    def __init__(self) -> None:
        self.tools: list[tuple[ToolOrigin, str | None]] = []

    def tool_begins(self, tool: ToolOrigin, counted_from: str | None, _seen_s: dict[str, float]) -> None:
        self.tools.append((tool, counted_from))

    def tool_set_right(self, *_: object) -> None:
        pass


def estimate(reference_id: str = "r1", **increments: float) -> SimpleNamespace:
    trace = SimpleNamespace(first_byte=SimpleNamespace(monotonic_s=10.0))
    return SimpleNamespace(reference_id=reference_id, label_increment_degc=increments, trace=trace)


@pytest.mark.parametrize("by_poll", [True, False])
def test_a_label_whose_sensors_are_away_begins_at_what_it_had_and_not_at_the_reference(by_poll: bool) -> None:
    references = Taken()
    tool = ToolInSpindle(references)
    tool.on_sample(1, estimate(nose=4.0, room=1.0))
    now = estimate(room=1.5)
    if by_poll:
        tool.on_sample(2, now)
    else:
        tool.begin(2, now)
    assert references.tools == [(ToolOrigin(number=2, begin_degc={"nose": 4.0, "room": 1.5}), "r1")]


def test_what_a_label_had_since_another_reference_does_not_count() -> None:
    references = Taken()
    tool = ToolInSpindle(references)
    tool.on_sample(1, estimate(nose=4.0, room=1.0))
    tool.begin(2, estimate("r2", room=0.5))
    assert references.tools == [(ToolOrigin(number=2, begin_degc={"room": 0.5}), "r2")]
    tool.begin(3, None)
    assert references.tools[1][1] is None
    assert replace(references.tools[1][0], begin_degc={}) == ToolOrigin(number=3, begin_degc={})
