"""Checks passwords, one at a time and not without end: whoever guesses waits. Monitor and OPC UA server share it."""

import asyncio
import math
import secrets
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence

from daemon.monitor.accounts import Account, hashed, verified
from daemon.rate_limit import RateLimit

MOST_FAILURES = 5
FAILURE_WINDOW_S = 60.0
"""So many wrong passwords within this time are taken from one address or for one account [s]."""
MOST_ADDRESSES = 4096
MOST_NAME = 64
"""No account's name is longer; of one that is, no more is kept and told."""
TOLD_S = 600.0
"""Ten wrong passwords within this time stand in the audit one by one, which is kept for years; the others as a number
[s]."""


class WrongPasswordError(Exception):
    """Name or password is wrong; the text does not say which."""


class TooManyWrongError(WrongPasswordError):
    """Too many were wrong: no other is taken for a while."""

    def __init__(self, wait_s: float) -> None:
        """`wait_s`: so long [s]."""
        super().__init__(f"too many wrong passwords for this account or from this address; try again in {wait_s:.0f} s")
        self.wait_s = wait_s


def wrong_passwords(report: Callable[[str, str, str | None], object]) -> RateLimit[tuple[str, str]]:
    """Return what puts sentences on wrong passwords, with the address, into the audit: few, however many guess."""

    def say(wrong: tuple[str, str], left_out: int) -> None:
        sentence, address = wrong
        more = f", and {left_out} times more since the one before" if left_out else ""
        report("access", f"{sentence}{more}", address)

    return RateLimit(say, period_s=TOLD_S)


class Passwords:
    """Checks passwords against the hashes of the accounts, and counts the wrong ones.

    An account's own people are not kept out by others who guess: where it has logged in before, only what is wrong for
    it from there counts. One address may be that of many: of a gateway, or of a computer with a client's old password.
    """

    def __init__(self, now_s: Callable[[], float] = time.monotonic) -> None:
        self._now_s = now_s
        self._failures: dict[str, deque[float]] = {}
        self._known: dict[tuple[str, str], None] = {}
        """Accounts, and addresses from which they have logged in."""
        self._decoy = ""
        """Hash that is checked for a name that does not exist."""
        self._one_at_a_time = asyncio.Lock()
        """Each check takes 9 MiB."""

    async def check(self, accounts: Mapping[str, Account], name: str, password: str, address: str) -> Account:
        """Return the account whose password this is; raises WrongPasswordError, or TooManyWrongError."""
        keys = [f"address {address}", f"account {name[:MOST_NAME]}"]
        if (name, address) in self._known:
            keys = [f"{address} {name}"]
        self._refuse_guessing(keys)
        async with self._one_at_a_time:
            self._refuse_guessing(keys)  # those before it in the queue may have been wrong
            self._decoy = self._decoy or await asyncio.to_thread(hashed, secrets.token_urlsafe(16))
            known = accounts.get(name)
            right = await asyncio.to_thread(verified, known.password_hash if known else self._decoy, password)
            if known is None or not right:
                self._failed(keys)
        if known is None or not right:
            raise WrongPasswordError(
                "name or password is wrong; `toolpoint users list` on the computer shows the names"
            )
        self._known[name, address] = None
        if len(self._known) > MOST_ADDRESSES:
            del self._known[next(iter(self._known))]
        return known

    def _refuse_guessing(self, keys: Sequence[str]) -> None:
        counted = [self._failures[key] for key in keys if key in self._failures]
        full = [failures[0] for failures in counted if len(failures) == MOST_FAILURES]
        if (wait_s := max(full, default=-math.inf) + FAILURE_WINDOW_S - self._now_s()) > 0.0:
            raise TooManyWrongError(wait_s)

    def _failed(self, keys: Sequence[str]) -> None:
        for key in keys:
            failures = self._failures.pop(key, None) or deque(maxlen=MOST_FAILURES)
            failures.append(self._now_s())
            self._failures[key] = failures
        while len(self._failures) > MOST_ADDRESSES:
            del self._failures[next(iter(self._failures))]
