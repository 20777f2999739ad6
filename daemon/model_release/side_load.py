"""Loads the released thermal model in a process beside the daemon, so that reading and checking it holds nothing up.

`python -P -m daemon.model_release.side_load FD` reads the configuration from standard input and leaves the model in the
shared memory behind FD: parsing in the daemon would take a third of a second in which no other thread runs.
"""

import asyncio
import io
import mmap
import os
import pickle
import struct
import sys

from config.schema import Configuration
from daemon.model_release.file_access import own_account
from daemon.model_release.loading import LoadedModel, load_released
from models.thermal.family import ThermalModel

NICENESS = "15"
PATIENCE_S = 120.0
"""A process that has not loaded the model after so long is ended [s of the wall clock]."""
ALIGNMENT = 64
_COUNT = struct.Struct("<q")


async def load_beside(configuration: Configuration) -> LoadedModel[ThermalModel]:
    """Return the configured thermal model as this account may use it, or why there is none."""
    try:
        descriptor = os.memfd_create("toolpoint-model", os.MFD_CLOEXEC)
        try:
            problem = await _run(descriptor, pickle.dumps(configuration))
            found: LoadedModel[ThermalModel] | None = None if problem else unpack(descriptor)
        finally:
            os.close(descriptor)
    except OSError as error:
        found, problem = None, str(error)
    return found or LoadedModel(model=None, inhibit=f"the process that loads a model failed: {problem}")


async def _run(descriptor: int, configuration: bytes) -> str:
    """Run the process; return what went wrong, '' when it has left a model or a refusal."""
    process = await asyncio.create_subprocess_exec(
        *("nice", "-n", NICENESS, sys.executable, "-P", "-m", "daemon.model_release.side_load", str(descriptor)),
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.DEVNULL,
        stderr=asyncio.subprocess.PIPE,
        pass_fds=(descriptor,),
    )
    try:
        async with asyncio.timeout(PATIENCE_S):
            _, words = await process.communicate(configuration)
    except TimeoutError:
        return f"no answer within {PATIENCE_S:g} s"
    finally:
        if process.returncode is None:
            process.kill()
            await process.wait()
    if process.returncode == 0:
        return ""
    said = words.decode("utf-8", "replace").strip().splitlines()
    return said[-1] if said else f"status {process.returncode}"


def pack(found: LoadedModel[ThermalModel], file: io.FileIO) -> None:
    """Write a model: sizes, the records, and each array's bytes where a mapped array may begin."""
    buffers: list[pickle.PickleBuffer] = []
    parts = [memoryview(pickle.dumps(found, protocol=5, buffer_callback=buffers.append))]
    parts += [buffer.raw() for buffer in buffers]
    header = b"".join(_COUNT.pack(number) for number in (len(parts), *(part.nbytes for part in parts)))
    for part in (memoryview(header), *parts):
        written = 0
        while written < part.nbytes:
            written += file.write(part[written:])
        file.seek(-file.tell() % ALIGNMENT, os.SEEK_CUR)


def unpack(descriptor: int) -> LoadedModel[ThermalModel]:
    """Return what `pack` wrote; its arrays are the file's pages, which cannot be written."""
    view = memoryview(mmap.mmap(descriptor, 0, prot=mmap.PROT_READ, flags=mmap.MAP_PRIVATE))
    (count,) = _COUNT.unpack_from(view)
    at = _COUNT.size * (1 + count)
    parts: list[memoryview] = []
    for index in range(count):
        (size,) = _COUNT.unpack_from(view, _COUNT.size * (1 + index))
        at += -at % ALIGNMENT
        parts.append(view[at : at + size])
        at += size
    found = pickle.loads(parts[0], buffers=parts[1:])
    assert isinstance(found, LoadedModel)
    return found


def main() -> None:
    """Load, pack and end; called in the process beside the daemon."""
    configuration = pickle.load(sys.stdin.buffer)
    with io.FileIO(int(sys.argv[1]), "w", closefd=False) as file:
        pack(load_released(configuration, own_account()), file)
        file.truncate()


if __name__ == "__main__":
    main()
