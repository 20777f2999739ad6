"""The accounts of the monitor: one file, one line each, `name:role:hash`, passwords hashed with Argon2id."""

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from argon2 import PasswordHasher
from argon2.exceptions import Argon2Error, InvalidHashError

from config.files import read_closed, stamp_of, write_whole
from models.errors import RefusedInputError

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._@-]{0,63}")
HASH = re.compile(r"\$argon2id\$v=\d+\$m=\d+,t=\d+,p=\d+\$[A-Za-z0-9+/]{11,}\$[A-Za-z0-9+/]{16,}")
LEAST_PASSWORD = 10
MOST_PASSWORD = 256
MOST_ACCOUNTS = 1000
HASHER = PasswordHasher(time_cost=4, memory_cost=9216, parallelism=1)
"""One of OWASP's equal settings of Argon2id; its 9 MiB leave the daemon within its memory."""


class AccountsError(RefusedInputError):
    """The file of accounts cannot be used; the text says why and what to do."""


class Role(StrEnum):
    """What an account may do; each may do what those before it may."""

    VIEWER = "viewer"
    """Look, and download."""
    OPERATOR = "operator"
    """Set references, switch compensation on and off, acknowledge."""
    ENGINEER = "engineer"
    """Switch the tuning of the spindle speed too."""

    def covers(self, needed: "Role") -> bool:
        """Return whether this role may do what `needed` may."""
        order = list(Role)
        return order.index(self) >= order.index(needed)


@dataclass(frozen=True, slots=True, kw_only=True)
class Account:
    name: str
    role: Role
    password_hash: str


def hashed(password: str) -> str:
    """Return a password's hash; raises AccountsError when it is too short or too long."""
    if not LEAST_PASSWORD <= len(password) <= MOST_PASSWORD:
        raise AccountsError(f"a password has {LEAST_PASSWORD} to {MOST_PASSWORD} characters, this one {len(password)}")
    return HASHER.hash(password)


def verified(password_hash: str, password: str) -> bool:
    """Return whether a password is the one of the hash; takes some hundredths of a second."""
    try:
        return HASHER.verify(password_hash, password)
    except (Argon2Error, InvalidHashError):
        return False


def read_accounts(path: Path) -> dict[str, Account]:
    """Return the accounts of a file by name; raises AccountsError naming file and line."""
    try:
        lines = read_closed(path).decode().splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise AccountsError(
            f"{path}: the accounts of the monitor cannot be read ({getattr(error, 'strerror', None) or error}); "
            "`toolpoint users add NAME` makes the file"
        ) from error
    accounts: dict[str, Account] = {}
    for number, line in enumerate(lines, 1):
        if not line.strip() or line.startswith("#"):
            continue
        account = _account(line, f"{path}, line {number}")
        if account.name in accounts:
            raise AccountsError(f"{path}, line {number}: {account.name} is there twice; remove one of the lines")
        accounts[account.name] = account
    return accounts


def _account(line: str, place: str) -> Account:
    name, _, rest = line.strip().partition(":")
    role, _, password_hash = rest.partition(":")
    if not NAME.fullmatch(name):
        raise AccountsError(f"{place}: {name!r} is no name of an account; it has letters, digits and . _ @ -")
    if role not in set(Role):
        raise AccountsError(f"{place}: {role!r} is no role; there are {', '.join(Role)}")
    if not HASH.fullmatch(password_hash):
        raise AccountsError(f"{place}: the password of {name} is not hashed with Argon2id; `toolpoint users password`")
    return Account(name=name, role=Role(role), password_hash=password_hash)


def write_accounts(path: Path, accounts: Mapping[str, Account]) -> None:
    """Write all accounts to the file, for its owner and group; raises AccountsError."""
    if len(accounts) > MOST_ACCOUNTS:
        raise AccountsError(f"{path}: at most {MOST_ACCOUNTS} accounts")
    text = "".join(f"{each.name}:{each.role}:{each.password_hash}\n" for each in accounts.values())
    try:
        before = path.stat() if path.exists() else None
        write_whole(path, text, mode=0o640)
        if before is not None:
            os.chown(path, before.st_uid, before.st_gid)
    except OSError as error:
        raise AccountsError(f"{path}: cannot be written ({error.strerror}) by this account") from error


class Accounts:
    """The accounts of a file, read again when it changes."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._seen: object = None
        self._accounts: dict[str, Account] = {}
        self.problem = ""
        """Why nobody can log in, '' when the file is good."""

    def now(self) -> Mapping[str, Account]:
        """Return the accounts as the file is now; none while it cannot be used."""
        if not (seen := stamp_of(self.path)) or seen != self._seen:
            self._seen = seen
            try:
                self._accounts, self.problem = read_accounts(self.path), ""
            except AccountsError as error:
                self._accounts, self.problem = {}, str(error)
        return self._accounts
