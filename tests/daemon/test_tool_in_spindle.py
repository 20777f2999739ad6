"""What the expansion of a tool counts from when sensors of its term are away as it comes into the spindle."""

from collections.abc import Mapping
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from daemon.compensation.tool import ToolInSpindle
from daemon.estimation.sensor_memory import SinceReference
from models.control import reference
from models.control.reference_records import ReferenceMemory, ReferenceRecord, ToolOrigin
from models.records import Instant, Reference


class Taken:
    """Takes what the references are told."""

    left = tool_seen = None
    kept_id: str | None = "r1"

    def __init__(self) -> None:
        self.tools: list[tuple[ToolOrigin, str | None]] = []

    @property
    def labels_at_reference(self) -> dict[str, tuple[float, float]]:
        return {}

    def tool_begins(self, tool: ToolOrigin, counted_from: str | None, _shown_s: dict[str, float]) -> None:
        self.tools.append((tool, counted_from))

    def tool_set_right(self, *_: object) -> None:
        pass


def estimate(reference_id: str = "r1", **increments: float) -> SimpleNamespace:
    trace = SimpleNamespace(first_byte=SimpleNamespace(monotonic_s=10.0))
    return SimpleNamespace(reference_id=reference_id, label_increment_degc=increments, trace=trace, held_s=0.0)


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
    references.kept_id = "r2"
    tool.begin(2, estimate("r2", room=0.5))
    assert references.tools == [(ToolOrigin(number=2, begin_degc={"room": 0.5}), "r2")]
    references.kept_id = None
    tool.begin(3, None)
    assert references.tools[1][1] is None
    assert replace(references.tools[1][0], begin_degc={}) == ToolOrigin(number=3, begin_degc={})


class Kept:
    """Keeps the reference's memory as the output does, without a store."""

    left = tool_seen = None
    kept_id = "r1"

    def __init__(self, memory: ReferenceMemory) -> None:
        self.memory = memory
        self.now_s = 0.0

    @property
    def labels_at_reference(self) -> dict[str, tuple[float, float]]:
        return {"nose": (0.0, 0.0)}

    def tool_begins(self, tool: ToolOrigin, counted_from: str | None, shown_s: Mapping[str, float]) -> None:
        self.memory = reference.tool_begins(self.memory, tool, counted_from, self.now_s, shown_s)

    def tool_set_right(
        self, before: Mapping[str, tuple[float, float]], now_degc: Mapping[str, float], now_s: float
    ) -> None:
        self.memory = reference.tool_set_right(self.memory, before, now_degc, now_s)


AWAY_S, BACK_S, END_S = 600.0, 1440.0, 2400.0
HELD_S = 120.0
"""The last temperature counts for so long though none comes [s]."""


def nose_degc(time_s: float) -> float:
    """The nose warms while nobody hears of it, and stays as warm."""
    return float(np.interp(time_s, [AWAY_S, BACK_S], [20.0, 22.6]))


@pytest.mark.parametrize(
    ("comes_s", "known"),
    [(300.0, True), (640.0, True), (690.0, False), (900.0, False), (1410.0, True)]
    + [(BACK_S + after_s, True) for after_s in (5.0, 15.0, 30.0, 60.0, 300.0)],
)
def test_a_tool_counts_from_what_its_sensor_had_when_it_came_or_nobody_knows(comes_s: float, known: bool) -> None:
    """What is held is of before: a tool that came 111 s into a silence of 212 s began at what was read before it."""
    since = SinceReference([7], {"nose": np.array([0])})
    origin = Reference(
        reference_id="r1",
        time=Instant(monotonic_s=0.0, utc_s=0.0, real_s=0.0),
        source="",
        degc=np.array([20.0]),
        program=1,
        work_offset=54,
        power_on_count=1,
    )
    since.begin(origin)
    kept = Kept(ReferenceMemory(record=ReferenceRecord(reference=origin)))
    tool = ToolInSpindle(kept)  # type: ignore[arg-type]
    shown: dict[str, float] = {}
    for time_s in np.arange(10.0, END_S, 5.0):
        kept.now_s = time_s
        if time_s % 10.0 == 0.0:
            held = AWAY_S < time_s <= AWAY_S + HELD_S
            heard = np.nan if AWAY_S + HELD_S < time_s < BACK_S else nose_degc(AWAY_S if held else time_s)
            shown = since.label_increments(np.array([heard]), time_s / 60.0)
            now = estimate(**shown)
            now.trace.first_byte.monotonic_s, now.held_s = time_s, time_s - AWAY_S if held else 0.0
            if (sensors := since.changed()) is not None:
                kept.memory = reference.with_sensors(kept.memory, sensors, time_s, tool.seen_s)
            tool.on_sample(1 if time_s < comes_s else 2, now)
        elif time_s >= comes_s:
            tool.on_sample(2, now)
    begin_degc = reference.tool_origin(kept.memory, 2, "r1").begin_degc["nose"]
    if known:
        assert shown["nose"] - begin_degc == pytest.approx(22.6 - nose_degc(comes_s), abs=0.1)
    else:
        assert np.isnan(begin_degc)
