"""Checks passwords, one at a time and not without end: whoever guesses waits. Monitor and OPC UA server share it."""

import asyncio
import secrets
import time
from collections import deque
from collections.abc import Callable, Mapping

from daemon.monitor.accounts import Account, hashed, verified

MOST_FAILURES = 5
FAILURE_WINDOW_S = 60.0
"""So many wrong passwords within this time are taken from one address or for one account [s]."""
MOST_ADDRESSES = 4096
MOST_NAME = 64
"""No account's name is longer; of one that is, no more is kept and told."""


class WrongPasswordError(Exception):
    """Name or password is wrong; the text does not say which."""


class TooManyWrongError(WrongPasswordError):
    """Too many were wrong: no other is taken for a while."""

    def __init__(self, wait_s: float) -> None:
        """`wait_s`: so long [s]."""
        super().__init__(f"too many wrong passwords for this account or from this address; try again in {wait_s:.0f} s")
        self.wait_s = wait_s


class LoginLimit:
    """Counts wrong passwords by address and by account."""

    def __init__(self, now_s: Callable[[], float]) -> None:
        self._now_s = now_s
        self._failures: dict[str, deque[float]] = {}

    def wait_s(self, *keys: str) -> float:
        """Return how long one of these must wait before another password is taken [s]."""
        return max((self._wait_of(key) for key in keys), default=0.0)

    def _wait_of(self, key: str) -> float:
        failures = self._failures.get(key)
        if not failures or len(failures) < MOST_FAILURES:
            return 0.0
        return max(0.0, failures[0] + FAILURE_WINDOW_S - self._now_s())

    def failed(self, *keys: str) -> None:
        """Note a wrong password."""
        for key in keys:
            failures = self._failures.pop(key, None) or deque(maxlen=MOST_FAILURES)
            failures.append(self._now_s())
            self._failures[key] = failures
        while len(self._failures) > MOST_ADDRESSES:
            del self._failures[next(iter(self._failures))]


class Passwords:
    """Checks passwords against the hashes of the accounts."""

    def __init__(self, now_s: Callable[[], float] = time.monotonic) -> None:
        self._limit = LoginLimit(now_s)
        self._decoy = ""
        """Hash that is checked for a name that does not exist."""
        self._one_at_a_time = asyncio.Lock()
        """Each check takes 9 MiB."""

    async def check(self, accounts: Mapping[str, Account], name: str, password: str, address: str) -> Account:
        """Return the account whose password this is; raises WrongPasswordError, or TooManyWrongError."""
        keys = (f"address {address}", f"account {name[:MOST_NAME]}")
        self._refuse_guessing(keys)
        async with self._one_at_a_time:
            self._refuse_guessing(keys)  # those before it in the queue may have been wrong
            self._decoy = self._decoy or await asyncio.to_thread(hashed, secrets.token_urlsafe(16))
            known = accounts.get(name)
            right = await asyncio.to_thread(verified, known.password_hash if known else self._decoy, password)
            if known is None or not right:
                self._limit.failed(*keys)
        if known is None or not right:
            raise WrongPasswordError(
                "name or password is wrong; `toolpoint users list` on the computer shows the names"
            )
        return known

    def _refuse_guessing(self, keys: tuple[str, str]) -> None:
        if (wait_s := self._limit.wait_s(*keys)) > 0.0:
            raise TooManyWrongError(wait_s)
