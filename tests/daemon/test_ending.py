"""Signals end a process whatever its main thread is doing, and however many come at once."""

import subprocess
import sys

WAITING = """
import os, signal
from daemon.ending import set_by_signals
stop = set_by_signals(signal.SIGTERM, signal.SIGINT)
with stop._cond:  # as inside the event's own wait or set
    os.kill(os.getpid(), signal.SIGTERM)
    os.kill(os.getpid(), signal.SIGINT)
    for _ in range(100_000):
        os.kill(os.getpid(), signal.SIGTERM)
print(stop.wait(30.0))
"""


def test_signals_that_interrupt_the_event_itself_do_not_wait_for_it() -> None:
    done = subprocess.run([sys.executable, "-c", WAITING], capture_output=True, text=True, timeout=60.0, check=False)
    assert done.stdout == "True\n" and done.returncode == 0, done.stderr
