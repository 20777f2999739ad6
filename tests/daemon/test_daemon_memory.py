"""What a daemon that runs for long keeps: one heap for all threads, few pages of the store, one model."""

import asyncio
import gc
import subprocess
import sys
import weakref
from pathlib import Path

import pytest
from thermal_rig import Task, model

KIB = 1024.0
THREADS = """
import sys, threading
sys.path.insert(0, sys.argv[1])
from heaps import thread_heaps
from daemon.telemetry.metrics import keep_one_heap

if sys.argv[2] == "one":
    keep_one_heap()
met = threading.Barrier(4)

def work() -> None:
    kept = [bytes(2000) for _ in range(100)]
    met.wait()
    met.wait()

threads = [threading.Thread(target=work) for _ in range(3)]
for thread in threads:
    thread.start()
met.wait()
print(thread_heaps("self"))
met.wait()
"""


@pytest.mark.parametrize(("choice", "heaps"), [("one", 0), ("each its own", 3)])
def test_threads_share_one_heap(choice: str, heaps: int) -> None:
    support = str(Path(__file__).parents[1] / "support")
    command = [sys.executable, "-P", "-c", THREADS, support, choice]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert int(done.stdout) == heaps


MALLOC = """
import ctypes, sys
from pathlib import Path
from daemon.history.database import connect_writer
from daemon.telemetry.metrics import keep_one_heap

class Malloc(ctypes.Structure):
    _fields_ = [(name, ctypes.c_size_t) for name in
                "arena ordblks smblks hblks hblkhd usmblks fsmblks uordblks fordblks keepcost".split()]

library = ctypes.CDLL(None)
library.mallinfo2.restype = Malloc
"""
LARGE = """
if sys.argv[1] == "given back":
    keep_one_heap()
before = library.mallinfo2().arena
for mib in (20, 16):
    large = bytearray(mib << 20)
    beside = bytes(2000)
    del large
print(library.mallinfo2().arena - before)
"""


@pytest.mark.parametrize(("kept", "least_kib", "most_kib"), [("given back", 0, 2048), ("kept", 15_000, 17_000)])
def test_what_was_large_is_given_back_when_it_is_freed(kept: str, least_kib: int, most_kib: int) -> None:
    command = [sys.executable, "-P", "-c", MALLOC + LARGE, kept]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert least_kib <= int(done.stdout) / KIB <= most_kib


CACHE = """
used = lambda: sum(getattr(library.mallinfo2(), name) for name in ("uordblks", "hblkhd"))
connection = connect_writer(Path(sys.argv[1]))
connection.execute("CREATE TABLE records (number INTEGER PRIMARY KEY, content BLOB)")
before = used()
for number in range(1000):
    connection.execute("INSERT INTO records VALUES (?, zeroblob(8000))", (number,))
print(used() - before)
"""


def test_the_writer_keeps_few_pages_of_the_store(tmp_path: Path) -> None:
    command = [sys.executable, "-P", "-c", MALLOC + CACHE, str(tmp_path / "history.db")]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert int(done.stdout) / KIB < 800.0, "of 8000 KiB that were written"


async def test_nothing_holds_a_model_that_another_one_has_replaced(tmp_path: Path) -> None:
    first = model()
    task = Task(tmp_path, first)
    task.history.start()
    try:
        await task.minutes(2)
        await task.ask()
        await task.minutes(1)
        replaced = weakref.ref(first.centre)
        del first
        await task.task.use_model(model(model_id="next"))
        await task.minutes(2)
        assert [one.model_id for one in task.estimates[:: len(task.estimates) - 1]] == ["made-up", "next"]
        gc.collect()
        assert replaced() is None
    finally:
        await asyncio.to_thread(task.history.close)
