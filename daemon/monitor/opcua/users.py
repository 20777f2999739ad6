"""Who may look and act over OPC UA: the monitor's accounts, with their roles, and nobody else."""

from collections.abc import Callable
from dataclasses import dataclass, replace

from daemon.monitor.accounts import MOST_PASSWORD, Accounts, Role
from daemon.monitor.passwords import MOST_NAME, Passwords, TooManyWrongError, WrongPasswordError, wrong_passwords
from drivers.opcua.server.settings import LoginRefusedError

Report = Callable[[str, str, str | None], object]
"""Takes the kind of an event, its text and the person."""


@dataclass(frozen=True, slots=True, kw_only=True)
class OpcUaPerson:
    """Who asks."""

    name: str
    role: Role
    address: str
    password_hash: str
    """Of the password with which they logged in."""

    @property
    def in_audit(self) -> str:
        """The person as the audit names them."""
        return f"{self.name} ({self.role}, OPC UA, {self.address})"


class AccountUsers:
    """Implements `drivers.opcua.server.settings.Users` on the file of accounts."""

    def __init__(self, accounts: Accounts, report: Report) -> None:
        self._accounts, self.report = accounts, report
        self._passwords, self._wrong = Passwords(), wrong_passwords(report)

    async def login(self, name: str, password: str, address: str) -> OpcUaPerson:
        """Return the person; raises LoginRefusedError."""
        accounts = self._accounts.now()
        if self._accounts.problem:
            raise LoginRefusedError(self._accounts.problem)
        if len(password) > MOST_PASSWORD:
            raise LoginRefusedError(f"a password has at most {MOST_PASSWORD} characters")
        try:
            account = await self._passwords.check(accounts, name, password, address)
        except TooManyWrongError as error:
            raise LoginRefusedError(str(error)) from error
        except WrongPasswordError as error:
            self._wrong((f"wrong name or password over OPC UA ({name[:MOST_NAME]!r})", address))
            raise LoginRefusedError(str(error)) from error
        person = OpcUaPerson(name=name, role=account.role, address=address, password_hash=account.password_hash)
        self.report("access", "logged in over OPC UA", person.in_audit)
        return person

    def present(self, person: OpcUaPerson) -> OpcUaPerson | None:
        """Return the person with the role that the file gives them now; None when account or password has changed."""
        account = self._accounts.now().get(person.name)
        if account is None or account.password_hash != person.password_hash:
            return None
        return person if account.role is person.role else replace(person, role=account.role)

    def left(self, person: OpcUaPerson) -> None:
        """Note that the session has ended."""
        self.report("access", "logged out over OPC UA", person.in_audit)
