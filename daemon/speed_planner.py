"""The process that plans the spindle speed: `python -m daemon.speed_planner`, started by the daemon alone.

Its first line of input is the configuration, every further line a request; it answers each with one line. It ends
with its input, with the daemon, with any defect, and before it takes so much memory that the daemon would lack it.
"""

import contextlib
import ctypes
import os
import resource
import signal
import sys
from pathlib import Path
from typing import BinaryIO

from config.schema import Configuration
from daemon.model_release.bearings import open_planning
from daemon.model_release.file_access import own_account
from daemon.spindle_speed.messages import REQUEST, OpenedModel, Reply, to_line
from daemon.spindle_speed.planning import SpeedPlanning

MOST_MEMORY_BYTES = 256 << 20
"""Of its own data; the unit has 512 MiB for everything."""
NICENESS = 5
"""Planning has a lower priority than the loop, which has deadlines."""
SIGNAL_WITH_THE_PARENT = 1
"""PR_SET_PDEATHSIG of prctl."""


def main() -> None:
    """Answer on standard output until the input ends."""
    _be_a_good_child()
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # what a library prints is no answer
    try:
        _serve(sys.stdin.buffer, answers)
    except BrokenPipeError:
        pass
    except Exception as error:
        _say(answers, Reply(defect=f"unexpected {type(error).__name__}: {error}"))
        raise


def _serve(requests: BinaryIO, answers: BinaryIO) -> None:
    configuration = Configuration.model_validate_json(requests.readline())
    tuning = configuration.spindle_speed
    assert tuning is not None
    found = open_planning(configuration, own_account())
    assert found.model is not None
    opened = OpenedModel(inhibit=found.inhibit, words=found.in_words(), model=found.model.snapshot())
    _say(answers, Reply(opened=opened))
    planning = SpeedPlanning(found.operations, tuning.sensor_step_k)
    for line in requests:
        _say(answers, Reply(planned=planning.answer(REQUEST.validate_json(line))))


def _say(answers: BinaryIO, reply: Reply) -> None:
    answers.write(to_line(reply))
    answers.flush()


def _be_a_good_child() -> None:
    """End with the daemon however that ends, be the first to be killed for memory, and leave signals to the daemon.

    Where the system refuses one of these, the end of the input still ends this process.
    """
    for number in (signal.SIGINT, signal.SIGTERM):  # sent to the whole group; the daemon ends this process itself
        signal.signal(number, signal.SIG_IGN)
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None, use_errno=True).prctl(SIGNAL_WITH_THE_PARENT, signal.SIGKILL)
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("500", encoding="ascii")
    with contextlib.suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_DATA, (MOST_MEMORY_BYTES, MOST_MEMORY_BYTES))
    with contextlib.suppress(OSError):
        os.nice(NICENESS)


if __name__ == "__main__":
    main()
