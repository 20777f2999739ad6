"""Packing in a process of its own, so that it takes no time from the control loop.

`python -P -m daemon.history.columns.packer STORE BEFORE_MS` reads the store and writes chunks to standard
output: length of a JSON header (4 bytes, big-endian), the header, the chunk's data, its extremes.
"""

import asyncio
import json
import os
import struct
import sys
from collections.abc import AsyncGenerator
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from typing import BinaryIO

from config.schema.service import HistoryConfig
from daemon.history.columns.packed_hour import PackedHour, packing_cutoff_ms
from daemon.history.database import connect_reader

_LENGTH = struct.Struct(">I")
_NICENESS = 15
_CHUNK_LIMIT = 2**24


def write_hour(stream: BinaryIO, hour: PackedHour) -> None:
    header = asdict(hour)
    del header["data"], header["extremes"]
    text = json.dumps(header | {"sizes": (len(hour.data), len(hour.extremes))}).encode("ascii")
    stream.write(_LENGTH.pack(len(text)) + text + hour.data + hour.extremes)
    stream.flush()


async def read_hour(stream: asyncio.StreamReader) -> PackedHour | None:
    """Read one chunk from a stream; None at its end."""
    try:
        length = await stream.readexactly(_LENGTH.size)
        header = json.loads(await stream.readexactly(_LENGTH.unpack(length)[0]))
        data, extremes = [await stream.readexactly(size) for size in header.pop("sizes")]
    except asyncio.IncompleteReadError:
        return None
    return PackedHour(**header, data=data, extremes=extremes)


async def packed_hours(path: Path, config: HistoryConfig, now_utc_s: float) -> AsyncGenerator[PackedHour, None]:
    """Yield the chunks that a packing process makes; raises OSError with its words when it fails."""
    before_ms = packing_cutoff_ms(now_utc_s, config.pack_after_s)
    process = await asyncio.create_subprocess_exec(
        sys.executable,
        "-P",
        "-m",
        "daemon.history.columns.packer",
        str(path),
        str(before_ms),
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
        limit=_CHUNK_LIMIT,
    )
    assert process.stdout is not None and process.stderr is not None
    try:
        while (hour := await read_hour(process.stdout)) is not None:
            yield hour
        words = (await process.stderr.read()).decode("utf-8", "replace").strip()
        if await process.wait() != 0:
            raise OSError(f"the packing process failed: {words.splitlines()[-1] if words else process.returncode}")
    finally:
        if process.returncode is None:
            process.kill()
            await process.wait()


def main() -> None:
    """Pack; called in the packing process."""
    from daemon.history.columns.packing import missing_extremes, pack_hours  # noqa: PLC0415 - by that process alone

    os.nice(_NICENESS)
    with closing(connect_reader(Path(sys.argv[1]))) as connection:
        for hours in (pack_hours(connection, int(sys.argv[2])), missing_extremes(connection)):
            for hour in hours:
                write_hour(sys.stdout.buffer, hour)


if __name__ == "__main__":
    main()
