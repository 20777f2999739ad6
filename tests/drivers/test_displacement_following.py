"""Displacement files that grow, are replaced or stay away, as shares and loggers make them."""

import asyncio
import errno
import os
import threading
import time
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from displacement_file import HEADER, PATIENCE_S, T0, Follower, append, config, minutes, row

from drivers.clock import SystemClock
from drivers.contract import DisplacementSource, LinkError
from drivers.displacement import source as displacement_csv
from drivers.displacement import tail
from drivers.displacement.source import DisplacementCsvSource
from drivers.displacement.tail import CATCH_UP_FILES, FileTail
from models.records import DisplacementSample


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "logger.csv"


def contract(source: DisplacementCsvSource) -> DisplacementSource:
    return source  # checked by mypy


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


@pytest.mark.parametrize("mark", [b"\xff\xfe", b"\xfe\xff", b""])
async def test_a_file_whose_lines_end_otherwise_is_followed_byte_by_byte(path: Path, mark: bytes) -> None:
    """UTF-16 says so itself; some instruments end a line with a carriage return alone."""
    encoding = tail.MARKS.get(mark, "latin-1")

    def written(text: str) -> bytes:
        return text.replace("\n", "\r\n" if mark else "\r").encode(encoding)

    path.write_bytes(mark + written(HEADER + row(0)))
    async with Follower(config(path)) as follower:
        await follower.until(1)
        for minute in (1, 2):
            for at, byte in enumerate(written(row(minute))):
                with path.open("ab") as file:
                    file.write(bytes([byte]))
                if at % 9 == 0:
                    await asyncio.sleep(0.02)
            await follower.until(1 + minute)
        path.write_bytes(mark + written(HEADER + row(3)))
        await follower.until(4)
    assert minutes(follower.samples) == [0, 1, 2, 3]
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


def old_files(folder: Path, count: int) -> None:
    for number in range(count):
        file = folder / f"day{number:03}.csv"
        file.write_text(HEADER + row(2 * number) + row(2 * number + 1))
        os.utime(file, (T0 + number, T0 + number))


async def test_a_file_that_was_renamed_when_the_next_one_began_repeats_nothing(tmp_path: Path) -> None:
    path = tmp_path / "logger.csv"
    append(path, HEADER + row(0) + row(1))
    async with Follower(config(tmp_path / "*.csv")) as follower:
        await follower.until(2)
        append(path, row(2))
        path.rename(tmp_path / "logger-1.csv")
        append(path, HEADER + row(3))
        await follower.until(4)
        await follower.settle()
    assert minutes(follower.samples) == [0, 1, 2, 3]


async def test_a_file_that_is_renamed_after_the_folder_was_listed_loses_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "logger.csv"
    append(path, HEADER + row(0) + row(1))
    rotate = asyncio.Event()
    listed = tail.glob.glob

    def listed_then_renamed(pattern: str) -> list[str]:
        found = listed(pattern)
        if rotate.is_set():
            rotate.clear()
            append(path, row(2))
            path.rename(tmp_path / "logger-1.csv")
            append(path, HEADER + row(3))
        return found

    monkeypatch.setattr(tail.glob, "glob", listed_then_renamed)
    async with Follower(config(tmp_path / "*.csv")) as follower:
        await follower.until(2)
        rotate.set()
        await follower.until(4)
        await follower.settle()
    assert minutes(follower.samples) == [0, 1, 2, 3]


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


async def test_rows_of_a_clock_that_is_right_again_are_not_skipped(path: Path) -> None:
    """A wrong `time_zone` had stamped rows nine hours ahead; corrected, it brought nothing for nine hours."""
    append(path, HEADER + row(0) + row(1))
    async with Follower(config(path), after_utc_s=T0 + 9 * 3600) as follower:
        assert await follower.settle() == []
        append(path, row(2))
        await follower.until(1)
    assert minutes(follower.samples) == [2]


async def test_a_file_that_is_written_anew_after_a_wrong_clock_is_read(path: Path) -> None:
    append(path, HEADER + "2099-01-01T00:00:00,1,2\n")
    soon = round((time.time() - T0) / 60) + 2
    async with Follower(config(path)) as follower:
        await follower.until(1)
        path.write_text(HEADER + row(0) + row(soon))
        await follower.until(2)
    assert minutes(follower.samples)[1] == soon, "and what is older counts as a repeat"


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


async def test_a_header_that_does_not_fit_is_a_lost_link_that_names_the_columns(path: Path) -> None:
    path.write_text("time,Y1,Z9,Z9\n" + row(0))
    with pytest.raises(LinkError, match=f"{path}:1: the header has no column 'Z1'; it has 'time', 'Y1', 'Z9', 'Z9'"):
        _ = [sample async for sample in failing(DisplacementCsvSource(config(path), SystemClock()))]
    twice = [{"name": "Z", "column": "Z9"}]
    with pytest.raises(LinkError, match="the header has 2 columns 'Z9'"):
        _ = [sample async for sample in failing(DisplacementCsvSource(config(path, channels=twice), SystemClock()))]
    path.write_text("time,Y1,Z1 µm\n" + row(0), encoding="cp1252")
    micro = [{"name": "Z", "column": "Z1 µm"}]
    with pytest.raises(LinkError, match=r"no column 'Z1 µm'; it has .* Correct `encoding` in the configuration"):
        _ = [sample async for sample in failing(DisplacementCsvSource(config(path, channels=micro), SystemClock()))]
    path.write_text("Zeit,Y1,Z1\n" + row(0))
    with pytest.raises(LinkError, match="none of its 2 lines starts with the header 'time'"):
        _ = [sample async for sample in failing(DisplacementCsvSource(config(path), SystemClock()))]


# The source as a whole


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


def test_a_line_that_is_too_long_costs_a_file_in_utf_16_that_line_alone(tmp_path: Path) -> None:
    """The logger's program may have written half of a character when it is looked at."""
    path, content = tmp_path / "log.csv", b"\xff\xfe" + f"{'1;' * 100}\n2;3\n4;5\n".encode("utf-16-le")
    tail, found, overlong = FileTail(path, 100), [], []
    for size in range(1, len(content) + 1, 8):
        path.write_bytes(content[:size])
        look = tail.look()
        found += [line.decode("utf-16-le") for _, line in look.lines]
        overlong += look.overlong
    path.write_bytes(content)
    found += [line.decode("utf-16-le") for _, line in tail.look().lines]
    assert (found, overlong) == (["2;3\n", "4;5\n"], [1])
