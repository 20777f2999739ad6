"""Whether another computer sends under the name of this machine to the same broker.

    TOPIC/MACHINE/store    claim STORE, when a sink begins; taken STORE, the answer of another that sends already

Of two that begin together the first in the broker's order has the name. Nothing is retained: who has it answers.
"""

import time
from collections import Counter
from contextlib import suppress

import structlog

from daemon.history.cursors import Cursor
from daemon.sinks.broker import Broker, Message
from daemon.sinks.broker_refusals import name_in_use
from daemon.sinks.contract import SinkError

log = structlog.get_logger(__name__)
ANSWER_S = 1.0
"""Another one has so long to answer before the first row goes."""
LATELY_S = 60.0
"""Whose rows the broker took so lately had the name: after a loss or a restart they do not wait for an answer."""
CLAIM, TAKEN = "claim", "taken"
_refused: set[tuple[str, str]] = set()
"""Topic and store that another one was in the way of: its rows wait for an answer again."""
TRIES = 3
_broken_off: Counter[tuple[str, str]] = Counter()
"""How often the connection was lost there in a row: a broker may do so where the user has no right to read."""


class OneName:
    """The claim of one store to a machine's name, at one connection."""

    def __init__(self, broker: Broker, topic: str, cursor: Cursor, machine: str) -> None:
        self._broker, self._topic, self._store, self._machine = broker, topic, cursor.generation, machine
        self._key = topic, cursor.generation
        lately = 0.0 <= time.time() - (cursor.acknowledged_utc_s or 0.0) < LATELY_S
        self._waits = not lately or self._key in _refused
        self._own = False
        """Whether the claim came back: from then on it is answered for."""
        self.taken = False

    def begin(self) -> None:
        """Claim the name; raises SinkError where another one has it."""
        if _broken_off[self._key] < TRIES:
            _broken_off[self._key] += 1
            self._claim()
        del _broken_off[self._key]
        self.check()
        if self._own:
            _refused.discard(self._key)
            return
        why = "`user_name` may not read and write there, so a second computer with the same `machine` is not noticed"
        log.warning("sink.name", topic=self._topic, problem=why)

    def _claim(self) -> None:
        self._broker.on_message(self._take)
        with suppress(SinkError):
            self._broker.subscribe(self._topic)
            self._broker.publish([self._message(CLAIM)])
            self._broker.comes(lambda: self.taken or (self._own and not self._waits), ANSWER_S)
        self._broker.check()

    def check(self) -> None:
        """Raise SinkError where another one has the name."""
        if self.taken:
            _refused.add(self._key)
            raise self._broker.problem(name_in_use(self._machine, self._topic))

    def _take(self, topic: str, content: bytes, retained: bool) -> None:
        """Take a message, in the library's thread."""
        said, _, store = content.decode("utf-8", "replace").partition(" ")
        if topic != self._topic or retained or said not in (CLAIM, TAKEN):
            return
        if store == self._store:
            self._own = True
        elif said == TAKEN or not self._own:
            self.taken = True
        elif not self.taken:
            self._broker.send(self._message(TAKEN, qos=0))  # an acknowledgement would be counted as that of a row

    def _message(self, word: str, qos: int = 1) -> Message:
        return Message(topic=self._topic, payload=f"{word} {self._store}".encode(), qos=qos)
