"""What ends a process that waits in threads: signals, whose handlers must take no lock that they may interrupt."""

import contextlib
import os
import signal
import threading


def set_by_signals(*numbers: signal.Signals) -> threading.Event:
    """Return an event that any of these signals sets, from the main thread's handlers by way of a pipe.

    A handler that sets the event itself waits for ever when it interrupts the event's own `wait` or `set`.
    """
    stop = threading.Event()
    reading, writing = os.pipe()
    os.set_blocking(writing, False)

    def tell(*_: object) -> None:
        with contextlib.suppress(BlockingIOError):  # so many have come that another one says nothing new
            os.write(writing, b"\0")

    def wait() -> None:
        os.read(reading, 1)
        stop.set()

    threading.Thread(target=wait, name="signals", daemon=True).start()
    for number in numbers:
        signal.signal(number, tell)
    return stop
