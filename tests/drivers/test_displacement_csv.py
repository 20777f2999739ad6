"""Displacement files as loggers write them, and as shares and loggers spoil them."""

import asyncio
import errno
import math
import os
import threading
import time
from collections.abc import AsyncIterator
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from config.schema.displacements import DisplacementsConfig
from drivers import displacement_csv
from drivers.clock import ScaledClock, SystemClock
from drivers.contract import DisplacementSource, LinkError
from drivers.displacement_csv import DisplacementCsvSource
from drivers.displacement_tail import CATCH_UP_FILES, FileTail
from models.quality import Reason
from models.records import DisplacementSample

PATIENCE_S = 20.0
T0 = datetime(2026, 1, 31, 8, 0, tzinfo=UTC).timestamp()


def config(path: Path, **file: Any) -> DisplacementsConfig:
    channels = file.pop("channels", [{"name": "Y", "column": "Y1"}, {"name": "Z", "column": "Z1"}])
    file = {"path": path, "header": "time", "poll_period_s": 0.01, **file}
    return DisplacementsConfig.model_validate({"file": file, "channels": channels})


def row(minute: int, y: object = 1.5, z: object = -2.25) -> str:
    stamp = datetime.fromtimestamp(T0 + 60 * minute, UTC).strftime("%Y-%m-%dT%H:%M:%S")
    return f"{stamp},{y},{z}\n"


HEADER = "time,Y1,Z1\n"


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "logger.csv"


def append(path: Path, text: str | bytes) -> None:
    with path.open("ab") as file:
        file.write(text if isinstance(text, bytes) else text.encode())


class Follower:
    """A source and the samples it has given."""

    def __init__(self, config: DisplacementsConfig, after_utc_s: float | None = None) -> None:
        self.source = DisplacementCsvSource(config, SystemClock(), after_utc_s=after_utc_s)
        self.samples: list[DisplacementSample] = []
        self._task: asyncio.Task[None] | None = None

    async def __aenter__(self) -> "Follower":
        self._task = asyncio.create_task(self._follow())
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.source.close()
        assert self._task is not None
        await asyncio.wait_for(self._task, PATIENCE_S)

    async def _follow(self) -> None:
        async for sample in self.source.samples():
            self.samples.append(sample)

    async def until(self, samples: int | None = None, problems: int | None = None) -> list[DisplacementSample]:
        async with asyncio.timeout(PATIENCE_S):
            while (samples is not None and len(self.samples) < samples) or (
                problems is not None and self.source.problems < problems
            ):
                assert self._task is not None
                if self._task.done():
                    self._task.result()
                await asyncio.sleep(0.005)
        return self.samples

    async def settle(self) -> list[DisplacementSample]:
        """Let the source look a few more times."""
        await asyncio.sleep(0.1)
        return self.samples


def minutes(samples: list[DisplacementSample]) -> list[float]:
    return [(sample.utc_s - T0) / 60 for sample in samples]


async def read_all(config: DisplacementsConfig, samples: int, problems: int = 0) -> tuple[Follower, list[Any]]:
    async with Follower(config) as follower:
        await follower.until(samples, problems)
        await follower.settle()
    assert len(follower.samples) == samples
    assert follower.source.problems == problems, follower.source.last_problem
    return follower, [[None if math.isnan(um) else um for um in sample.um] for sample in follower.samples]


def contract(source: DisplacementCsvSource) -> DisplacementSource:
    return source  # checked by mypy


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


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig"])
async def test_byte_order_mark(path: Path, encoding: str) -> None:
    path.write_bytes(b"\xef\xbb\xbf" + (HEADER + row(0)).encode())
    assert (await read_all(config(path, encoding=encoding), 1))[1] == [[1.5, -2.25]]


async def test_decimal_comma(path: Path) -> None:
    path.write_text("time;Y1;Z1\n2026-01-31T08:00:00;1,5;-,25\n2026-01-31T08:01:00;1.5;2\n")
    follower, values = await read_all(config(path, delimiter=";", decimal=","), 2, problems=1)
    assert values == [[1.5, -0.25], [None, 2.0]]
    assert follower.source.last_problem == f"{path}:3:2: '1.5' is no displacement for Y; it is left out"


async def test_quoted_fields(path: Path) -> None:
    path.write_text('"time","Y1","Z1, nose"\n"2026-01-31T08:00:00","1.5"," -2.25 "\n')
    channels = [{"name": "Y", "column": "Y1"}, {"name": "Z", "column": "Z1, nose"}]
    for header in ("time", '"time"'):
        assert (await read_all(config(path, header=header, channels=channels), 1))[1] == [[1.5, -2.25]]
    path.write_text('time\tY1\tZ1\n"2026-01-31T08:00:00"\t"1,5"\t" -2,25 "\n')
    assert (await read_all(config(path, decimal=",", delimiter="\t"), 1))[1] == [[1.5, -2.25]]


async def test_overflow_empty_and_unreadable_fields(path: Path) -> None:
    rows = [row(0, "+OVER", 1), row(1, "", 2), row(2, "nan", "1_0"), row(3, "inf", "1e400"), row(4, "٣", 5)]
    path.write_text(HEADER + "".join(rows), encoding="utf-8")
    follower, values = await read_all(config(path), 5, problems=5)
    assert values == [[None, 1.0], [None, 2.0], [None, None], [None, None], [None, 5.0]]
    reasons = [[Reason(code) for code in sample.reason] for sample in follower.samples]
    assert reasons[0] == [Reason.OVERFLOW, Reason.NONE]
    assert reasons[1] == [Reason.UNREADABLE, Reason.NONE]
    assert reasons[2] == [Reason.UNREADABLE, Reason.UNREADABLE]


async def test_no_header_and_seconds_since_1970(path: Path) -> None:
    path.write_text(f"{T0:.3f},9,1\n{T0 + 60:.3f},9,2\n")
    channels = [{"name": "Z", "column": 3}]
    follower, values = await read_all(config(path, header=None, channels=channels, time_format="%s"), 2)
    assert values == [[1.0], [2.0]]
    assert minutes(follower.samples) == [0, 1]


async def test_files_without_time_columns(path: Path) -> None:
    path.write_text("Y1,Z1\n1,2\n\n3,bad\n5,6\n")
    follower, values = await read_all(
        config(path, header="Y1", start="2026-01-31T17:00:00", interval_s=30.0, time_zone="Asia/Tokyo"), 3, problems=1
    )
    assert values == [[1, 2], [3, None], [5, 6]]
    assert minutes(follower.samples) == [0, 0.5, 1]


async def test_a_start_with_its_own_offset(path: Path) -> None:
    path.write_text("Y1,Z1\n1,2\n")
    follower, _ = await read_all(config(path, header="Y1", start="2026-01-31T09:00:00+01:00", interval_s=60.0), 1)
    assert minutes(follower.samples) == [0]


async def test_the_hour_that_comes_twice(path: Path) -> None:
    # In Berlin on 2026-10-25 the clock went from 03:00 CEST back to 02:00 CET.
    stamps = ["01:30", "02:00", "02:30", "02:00", "02:30", "03:00"]
    path.write_text(HEADER + "".join(f"2026-10-25T{stamp}:00,0,0\n" for stamp in stamps))
    follower, _ = await read_all(config(path, time_zone="Europe/Berlin"), 6)
    utc_s = [sample.utc_s for sample in follower.samples]
    assert [b - a for a, b in pairwise(utc_s)] == [1800.0] * 5


async def test_a_header_repeated_by_a_restarted_logger_may_order_columns_anew(path: Path) -> None:
    path.write_text(HEADER + row(0) + "time,Z1,Y1\n" + row(1))
    assert (await read_all(config(path), 2))[1] == [[1.5, -2.25], [-2.25, 1.5]]


# Bad rows


async def test_bad_rows_are_reported_with_their_place_and_skipped(path: Path) -> None:
    path.write_text(HEADER + "2026-13-01T00:00:00,1,2\n" + row(1))
    follower, _ = await read_all(config(path), 1, problems=1)
    assert follower.source.last_problem is not None
    assert follower.source.last_problem.startswith(f"{path}:2:1: the time stamp '2026-13-01T00:00:00' cannot be read")

    path.write_text(HEADER + "2026-01-31T08:00:00,1\n" + row(1))
    follower, _ = await read_all(config(path), 1, problems=1)
    assert follower.source.last_problem is not None
    assert f"{path}:2:2: this row has 2 fields where 3 are expected" in follower.source.last_problem


async def test_undecodable_bytes_cost_only_their_field(path: Path) -> None:
    path.write_bytes(HEADER.encode() + row(0).encode() + b"2026-01-31T08:01:00,\xff\xfe,7\n" + row(2).encode())
    assert (await read_all(config(path), 3, problems=1))[1] == [[1.5, -2.25], [None, 7.0], [1.5, -2.25]]


async def test_overlong_lines_are_skipped_whole_or_in_pieces(path: Path) -> None:
    append(path, HEADER + row(0) + "x" * 500 + "\n" + row(1))
    async with Follower(config(path, max_line_bytes=256)) as follower:
        await follower.until(2, problems=1)
        assert follower.source.last_problem == (
            f"{path}:3:1: this line is longer than max_line_bytes (256) and is skipped"
        )
        for _ in range(5):
            append(path, "y" * 100_000)
            await asyncio.sleep(0.02)
        append(path, "\n" + row(2))
        await follower.until(3, problems=2)
    assert minutes(follower.samples) == [0, 1, 2]
    assert follower.samples[-1].source == f"{path}:6"


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.binary(max_size=120), max_size=20))
async def test_garbage_never_raises(path: Path, garbage: list[bytes]) -> None:
    path.write_bytes(HEADER.encode() + b"".join(garbage) + b"\n" + row(9).encode())
    async with Follower(config(path)) as follower:
        while not follower.samples or follower.samples[-1].utc_s != T0 + 540:
            await follower.until(len(follower.samples) + 1)


# Growing, half-written, truncated, rotated


async def test_a_half_written_row_waits_for_its_end(path: Path) -> None:
    append(path, HEADER + row(0))
    async with Follower(config(path)) as follower:
        await follower.until(1)
        text = row(1)
        for at in range(len(text) - 1):
            append(path, text[at])
            if at % 9 == 0:
                await asyncio.sleep(0.02)
        assert len(await follower.settle()) == 1
        append(path, "\n")
        await follower.until(2)
    assert minutes(follower.samples) == [0, 1]
    assert follower.source.problems == 0


async def test_a_truncated_file_is_read_anew_and_repeats_nothing(path: Path) -> None:
    append(path, HEADER + row(0) + row(1))
    async with Follower(config(path)) as follower:
        await follower.until(2)
        path.write_text(HEADER + row(1))
        await follower.settle()
        append(path, row(2))
        await follower.until(3)
    assert minutes(follower.samples) == [0, 1, 2]
    assert follower.samples[-1].source == f"{path}:3"


async def test_a_replaced_file_of_any_size_is_noticed(path: Path, tmp_path: Path) -> None:
    append(path, HEADER + row(0) + row(1))
    async with Follower(config(path)) as follower:
        await follower.until(2)
        other = tmp_path / "other"
        other.write_text("Device,X\n" + HEADER + row(2) + row(3) + row(4))
        other.replace(path)
        await follower.until(5)
        # The same header and more bytes than before: only what was read last tells.
        other.write_text("Device,X\n" + HEADER + "".join(row(minute, 10000.125) for minute in range(5, 15)))
        other.replace(path)
        await follower.until(15)
    assert minutes(follower.samples) == list(range(15))


async def test_a_file_that_is_written_anew_with_one_row_more_is_only_read_on(path: Path, tmp_path: Path) -> None:
    append(path, HEADER + row(0))
    async with Follower(config(path)) as follower:
        for count in range(1, 6):
            await follower.until(count)
            (tmp_path / "new").write_text(HEADER + "".join(row(minute) for minute in range(count + 1)))
            (tmp_path / "new").replace(path)
        await follower.until(6)
        await follower.settle()
    assert minutes(follower.samples) == list(range(6))


async def test_the_old_file_is_finished_before_the_newest(tmp_path: Path) -> None:
    append(tmp_path / "a.csv", HEADER + row(0))
    async with Follower(config(tmp_path / "*.csv")) as follower:
        await follower.until(1)
        append(tmp_path / "b.csv", HEADER + row(2))
        append(tmp_path / "a.csv", row(1))
        os.utime(tmp_path / "b.csv", (time.time() + 5, time.time() + 5))
        await follower.until(3)
        append(tmp_path / "b.csv", row(3))
        await follower.until(4)
    assert minutes(follower.samples) == [0, 1, 2, 3]
    assert follower.samples[-1].source == f"{tmp_path / 'b.csv'}:3"


def old_files(folder: Path, count: int) -> None:
    for number in range(count):
        file = folder / f"day{number:03}.csv"
        file.write_text(HEADER + row(2 * number) + row(2 * number + 1))
        os.utime(file, (T0 + number, T0 + number))


async def test_only_the_newest_of_old_files_is_read_at_first(tmp_path: Path) -> None:
    old_files(tmp_path, 4)
    async with Follower(config(tmp_path / "*.csv")) as follower:
        await follower.until(2)
        assert minutes(await follower.settle()) == [6, 7]


async def test_after_a_restart_missed_rows_of_older_files_are_read(tmp_path: Path) -> None:
    old_files(tmp_path, CATCH_UP_FILES)
    async with Follower(config(tmp_path / "*.csv"), after_utc_s=T0 + 3 * 60) as follower:
        await follower.until(2 * CATCH_UP_FILES - 4)
        await follower.settle()
    assert minutes(follower.samples) == list(range(4, 2 * CATCH_UP_FILES))


async def test_rows_up_to_the_last_known_are_skipped(path: Path) -> None:
    append(path, HEADER + "".join(row(minute) for minute in range(10)))
    async with Follower(config(path), after_utc_s=T0 + 6 * 60) as follower:
        await follower.until(3)
        await follower.settle()
    assert minutes(follower.samples) == [7, 8, 9]
    assert follower.source.problems == 0


async def test_a_file_without_times_that_began_anew_is_not_guessed_at(path: Path) -> None:
    path.write_text("Y1,Z1\n1,2\n3,4\n")
    async with Follower(config(path, header="Y1", start="2026-01-31T08:00:00", interval_s=60.0)) as follower:
        await follower.until(2)
        path.write_text("Y1,Z1\n5,6\n")
        await follower.until(problems=1)
        assert len(await follower.settle()) == 2
        assert follower.source.last_problem is not None
        assert "began anew" in follower.source.last_problem


# Files that cannot be read


async def test_a_file_may_come_late_vanish_and_come_back(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(displacement_csv, "UNREACHABLE_LOOKS", 100_000)
    async with Follower(config(path)) as follower:
        await follower.until(problems=1)
        assert "No such file" in (follower.source.last_problem or "")
        append(path, HEADER + row(0))
        await follower.until(1)
        away = path.with_suffix(".away")
        path.rename(away)
        await follower.settle()
        away.rename(path)
        append(path, row(1))
        await follower.until(2)
        await follower.settle()
    assert minutes(follower.samples) == [0, 1]


@pytest.mark.parametrize("code", [errno.EACCES, errno.EBUSY, errno.ESTALE])
async def test_a_locked_file_is_tried_again(path: Path, monkeypatch: pytest.MonkeyPatch, code: int) -> None:
    # No file system here can be made to answer EBUSY or ESTALE, so the call itself answers.
    append(path, HEADER + row(0))
    refusals = 3
    look = FileTail.look

    def locked(tail: FileTail) -> object:
        nonlocal refusals
        if refusals:
            refusals -= 1
            raise OSError(code, os.strerror(code), str(path))
        return look(tail)

    monkeypatch.setattr(FileTail, "look", locked)
    async with Follower(config(path)) as follower:
        await follower.until(1)
    assert refusals == 0
    assert os.strerror(code) in (follower.source.last_problem or "")


async def failing(source: DisplacementSource) -> AsyncIterator[DisplacementSample]:
    async with asyncio.timeout(PATIENCE_S):
        async for sample in source.samples():
            yield sample


async def test_a_file_that_stays_away_is_a_lost_link(path: Path) -> None:
    source = contract(DisplacementCsvSource(config(path), SystemClock()))
    with pytest.raises(LinkError, match=f"displacement file {path}: .*No such file.*\\(24 looks .*mounted"):
        _ = [sample async for sample in failing(source)]
    pattern = path.parent / "*.csv"
    with pytest.raises(LinkError, match="no file matches the pattern"):
        _ = [sample async for sample in failing(DisplacementCsvSource(config(pattern), SystemClock()))]


async def test_a_header_that_does_not_fit_is_a_lost_link_that_names_the_columns(path: Path) -> None:
    path.write_text("time,Y1,Z9,Z9\n" + row(0))
    with pytest.raises(LinkError, match=f"{path}:1: the header has no column 'Z1'; it has 'time', 'Y1', 'Z9', 'Z9'"):
        _ = [sample async for sample in failing(DisplacementCsvSource(config(path), SystemClock()))]
    twice = [{"name": "Z", "column": "Z9"}]
    with pytest.raises(LinkError, match="the header has 2 columns 'Z9'"):
        _ = [sample async for sample in failing(DisplacementCsvSource(config(path, channels=twice), SystemClock()))]
    path.write_text("Zeit,Y1,Z1\n" + row(0))
    with pytest.raises(LinkError, match="none of its 2 lines starts with the header 'time'"):
        _ = [sample async for sample in failing(DisplacementCsvSource(config(path), SystemClock()))]


async def test_an_unfit_file_is_left_when_a_newer_one_fits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(displacement_csv, "UNREACHABLE_LOOKS", 100_000)
    append(tmp_path / "a.csv", "time,other\n" + row(0))
    async with Follower(config(tmp_path / "*.csv")) as follower:
        await follower.until(problems=1)
        append(tmp_path / "b.csv", HEADER + row(1))
        await follower.until(1)
    assert minutes(follower.samples) == [1]


# The source as a whole


async def test_no_file_is_open_between_looks_and_nothing_is_left_behind(path: Path) -> None:
    append(path, HEADER + row(0))
    async with Follower(config(path, poll_period_s=3600.0)) as follower:
        await follower.until(1)
        await follower.settle()
        open_files = [str(entry.readlink()) for entry in Path("/proc/self/fd").iterdir() if entry.is_symlink()]
        assert str(path) not in open_files
        await follower.source.close()
        await follower.source.close()
    assert not [thread for thread in threading.enumerate() if thread.name == "displacement-files"]


async def test_a_share_that_hangs_is_reported_and_does_not_stop_anything(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    released = threading.Event()
    look = FileTail.look

    def hanging(tail: FileTail) -> object:
        released.wait(PATIENCE_S)
        return look(tail)

    monkeypatch.setattr(FileTail, "look", hanging)
    monkeypatch.setattr(displacement_csv, "PATIENCE_REAL_S", 0.05)
    append(path, HEADER + row(0))
    async with Follower(config(path)) as follower:
        await follower.until(problems=1)
        assert "no answer for 0.05 s" in (follower.source.last_problem or "")
        released.set()
        await follower.until(1)


async def test_the_poll_period_is_time_of_the_given_clock(path: Path) -> None:
    append(path, HEADER + row(0))
    clock = ScaledClock(epoch_real_s=time.monotonic(), epoch_utc_s=T0, speed=600.0)
    source = DisplacementCsvSource(config(path, poll_period_s=30.0), clock)
    samples = source.samples()
    async with asyncio.timeout(PATIENCE_S):
        assert (await anext(samples)).utc_s == T0
        append(path, row(1))
        assert (await anext(samples)).utc_s == T0 + 60
    await source.close()
