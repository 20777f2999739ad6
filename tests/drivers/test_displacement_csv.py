"""Displacement files as loggers write them: what a file may look like, and its bad rows."""

from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path

import pytest
from displacement_file import HEADER, T0, Follower, append, config, minutes, read_all, row
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from models.quality import Reason


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "logger.csv"


# What a file may look like


async def test_rows_as_they_are_appended(path: Path) -> None:
    append(path, HEADER + row(0))
    async with Follower(config(path)) as follower:
        await follower.until(1)
        append(path, row(1, 3, 4))
        (first, second) = await follower.until(2)
    assert (first.utc_s, list(first.um), first.source) == (T0, [1.5, -2.25], f"{path}:2")
    assert (second.utc_s, list(second.um), second.source) == (T0 + 60, [3.0, 4.0], f"{path}:3")
    assert not first.reason.any()


async def test_japanese_logger_with_metadata_units_and_two_time_columns(path: Path) -> None:
    text = (
        "ファイル名,計測1\r\n"
        '"メモ, 表示","Z1"\r\n'
        "\r\n"
        "日付,時刻,変位Z1,温度,変位Y1\r\n"
        "-,-,um,℃,mm\r\n"
        "2026/01/31,17:00:00,-12.5,20.1,0.0015\r\n"
        "2026/01/31,17:01:00,-12.25,20.1,0.0020\r\n"
    )
    path.write_bytes(text.encode("cp932"))
    channels = [
        {"name": "Y", "column": "変位Y1", "scale_um": 1000.0},
        {"name": "Z", "column": "変位Z1", "scale_um": -1.0},
    ]
    follower, values = await read_all(
        config(
            path,
            channels=channels,
            encoding="cp932",
            header="日付",
            unit_row=True,
            time_columns=["日付", "時刻"],
            time_format="%Y/%m/%d %H:%M:%S",
            time_zone="Asia/Tokyo",
        ),
        2,
    )
    assert values == [[pytest.approx(1.5), 12.5], [pytest.approx(2.0), 12.25]]
    assert minutes(follower.samples) == [0, 1]
    assert follower.samples[0].source == f"{path}:6"


@pytest.mark.parametrize(("unit", "scale_um", "read"), [("mm", -1.0, None), ("um", 1000.0, None), ("V", 1.0, 1.5)])
async def test_a_row_of_units_that_says_another_unit_is_not_read_over(
    path: Path, unit: str, scale_um: float, read: float | None
) -> None:
    path.write_text(f"time,Y1\n-,{unit}\n2026-01-31T08:00:00,1.5\n", encoding="utf-8")
    channels = [{"name": "Y", "column": "Y1", "scale_um": scale_um}]
    opened = config(path, channels=channels, unit_row=True)
    if read is not None:
        assert (await read_all(opened, 1))[1] == [[read]]
        return
    follower, _ = await read_all(opened, 0, problems=1)
    assert f"logger.csv:2:2: the row of units says {unit} where Y is read in" in str(follower.source.last_problem)


async def test_decimal_comma(path: Path) -> None:
    path.write_text("time;Y1;Z1\n2026-01-31T08:00:00;1,5;-,25\n2026-01-31T08:01:00;1.5;2\n")
    follower, values = await read_all(config(path, delimiter=";", decimal=","), 2, problems=1)
    assert values == [[1.5, -0.25], [None, 2.0]]
    assert follower.source.last_problem == f"{path}:3:2: '1.5' is no number for Y; it is left out"


async def test_overflow_empty_and_unreadable_fields(path: Path) -> None:
    rows = [row(0, "+OVER", 1), row(1, "", 2), row(2, "nan", "1_0"), row(3, "inf", "1e400"), row(4, "٣", 5)]
    path.write_text(HEADER + "".join(rows), encoding="utf-8")
    follower, values = await read_all(config(path), 5, problems=5)
    assert values == [[None, 1.0], [None, 2.0], [None, None], [None, None], [None, 5.0]]
    reasons = [[Reason(code) for code in sample.reason] for sample in follower.samples]
    assert reasons[0] == [Reason.OVERFLOW, Reason.NONE]
    assert reasons[1] == [Reason.UNREADABLE, Reason.NONE]
    assert reasons[2] == [Reason.UNREADABLE, Reason.UNREADABLE]


async def test_the_hour_that_comes_twice(path: Path) -> None:
    # In Berlin on 2026-10-25 the clock went from 03:00 CEST back to 02:00 CET.
    stamps = ["01:30", "02:00", "02:30", "02:00", "02:30", "03:00"]
    path.write_text(HEADER + "".join(f"2026-10-25T{stamp}:00,0,0\n" for stamp in stamps))
    follower, _ = await read_all(config(path, time_zone="Europe/Berlin"), 6)
    utc_s = [sample.utc_s for sample in follower.samples]
    assert [b - a for a, b in pairwise(utc_s)] == [1800.0] * 5


async def test_rows_of_one_time_stamp_in_the_hour_that_comes_twice(path: Path) -> None:
    """Several rows a second, or a minute: the second of a pair was taken for an hour later, and all that followed."""
    stamps = [f"{hour}:{minute:02}" for hour in ("02", "02", "03") for minute in range(0, 60, 20) for _ in range(3)]
    path.write_text(HEADER + "".join(f"2026-10-25T{stamp}:00,0,0\n" for stamp in stamps))
    follower, _ = await read_all(config(path, time_zone="Europe/Berlin"), len(stamps))
    utc_s = [sample.utc_s for sample in follower.samples]
    assert [b - a for a, b in pairwise(utc_s)] == [0.0, 0.0, 1200.0] * 8 + [0.0, 0.0]
    assert utc_s[0] == datetime(2026, 10, 25, tzinfo=UTC).timestamp()


async def test_a_file_that_begins_in_the_hour_that_comes_twice(path: Path) -> None:
    """Loggers that begin a file each hour: all of the second 02:00 to 03:00 was taken for the first, and left out."""
    for name, stamps in (("a.csv", ("01:30", "02:00", "02:30")), ("b.csv", ("02:00", "02:30", "03:00"))):
        text = HEADER + "".join(f"2026-10-25T{stamp}:00,0,0\n" for stamp in stamps)
        path.with_name(name).write_text(text)
    pattern = config(path.with_name("*.csv"), time_zone="Europe/Berlin")
    async with Follower(pattern, after_utc_s=0.0) as follower:
        await follower.until(6)
    utc_s = [sample.utc_s for sample in follower.samples]
    assert [b - a for a, b in pairwise(utc_s)] == [1800.0] * 5


# Bad rows


async def test_a_time_that_no_calendar_has_is_refused(path: Path) -> None:
    """Milliseconds where seconds are configured: one such row kept a plant's database from taking any that followed."""
    path.write_text(f"{HEADER}{T0 * 1e3:.0f},1,2\n{T0:.0f},3,4\n")
    follower, values = await read_all(config(path, time_format="%s"), 1, problems=1)
    assert values == [[3.0, 4.0]]
    assert ":2:1: the time stamp" in str(follower.source.last_problem)


async def test_bad_rows_are_reported_with_their_place_and_skipped(path: Path) -> None:
    path.write_text(HEADER + "2026-13-01T00:00:00,1,2\n" + row(1))
    follower, _ = await read_all(config(path), 1, problems=1)
    assert follower.source.last_problem is not None
    assert follower.source.last_problem.startswith(f"{path}:2:1: the time stamp '2026-13-01T00:00:00' cannot be read")

    path.write_text(HEADER + "2026-01-31T08:00:00,1\n" + row(1))
    follower, _ = await read_all(config(path), 1, problems=1)
    assert follower.source.last_problem is not None
    assert f"{path}:2:2: this row has 2 fields where 3 are expected" in follower.source.last_problem

    path.write_text(HEADER + "2026-01-31T08:00:00,1,5,-2,25\n" + row(1))
    follower, values = await read_all(config(path), 1, problems=1)
    assert follower.source.last_problem is not None
    assert f"{path}:2:4: this row has 5 fields, the header 3" in follower.source.last_problem
    assert "`delimiter`" in follower.source.last_problem and values == [[1.5, -2.25]]


async def test_empty_fields_beyond_the_header_are_none(path: Path) -> None:
    path.write_text(HEADER + row(0).replace("\n", ",,\n"))
    assert (await read_all(config(path), 1))[1] == [[1.5, -2.25]]


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.binary(max_size=120), max_size=20))
async def test_garbage_never_raises(path: Path, garbage: list[bytes]) -> None:
    path.write_bytes(HEADER.encode() + b"".join(garbage) + b"\n" + row(9).encode())
    async with Follower(config(path)) as follower:
        while not follower.samples or follower.samples[-1].utc_s != T0 + 540:
            await follower.until(len(follower.samples) + 1)
