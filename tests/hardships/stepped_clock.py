"""The daemon's own command in a process whose calendar clock steps by what its standard input says.

`python stepped_clock.py FIRST_STEP_S run --config ...`: the calendar begins FIRST_STEP_S off, and every line
with a number shifts it by so many seconds. The monotonic clock goes on, as it does when a real computer's time is set.
"""

import sys
import threading
import time

import time_machine

from daemon.cli import main


def _follow(traveller: "time_machine.Coordinates") -> None:
    for line in sys.stdin:
        traveller.shift(float(line))


if __name__ == "__main__":
    first_s = float(sys.argv.pop(1))
    with time_machine.travel(time.time() + first_s, tick=True) as traveller:
        threading.Thread(target=_follow, args=(traveller,), daemon=True).start()
        main()
