"""`toolpoint users`: the accounts of the monitor."""

import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

import click

from daemon.cli.command_group import Group
from daemon.cli.common import FAILED, FILE, config_option, option, read_configuration, refuse, say, write_json
from daemon.cli.options import json_option

if TYPE_CHECKING:
    from daemon.monitor.accounts import Account


file_option = option("--file", "file", type=FILE, help="File of the accounts; without: service.users.")
password_option = click.option(
    "--password-file",
    type=click.File("r", encoding="utf-8-sig"),
    help="Take the password from the first line of a file, '-' for standard input; without: ask for it.",
)


@click.group(cls=Group)
def users() -> None:
    """Accounts of the monitor: who may look (viewer), act (operator), tune the spindle speed too (engineer).

    The file holds a line for each, with the password's Argon2id hash. The daemon takes up a change by itself; a file
    that it gets as a credential of its service changes with its next start.
    """


@users.command()
@click.argument("name")
@click.option(
    "--role", type=click.Choice(["viewer", "operator", "engineer"]), required=True, help="What the account may do."
)
@password_option
@file_option
@config_option
def add(name: str, role: str, password_file: TextIO | None, file: Path | None, config_path: Path) -> None:
    """Make the account NAME."""
    from daemon.monitor.accounts import NAME, Account, Role, hashed, write_accounts

    path, accounts = _accounts(file, config_path)
    if not NAME.fullmatch(name):
        refuse(f"{name!r} is no name of an account; it begins with a letter or digit, then letters, digits and . _ @ -")
    if name in accounts:
        words = f"{path}: there is an account {name} already; `toolpoint users password {name}` changes its password"
        refuse(words, FAILED)
    accounts[name] = Account(name=name, role=Role(role), password_hash=hashed(_password(name, password_file)))
    write_accounts(path, accounts)
    say(f"{path}: {name} may log in as {role}")
    if file is not None:
        say(f"the monitor knows it where the configuration says so: service.users: {path.resolve()}")


@users.command("list")
@file_option
@config_option
@json_option
def list_command(file: Path | None, config_path: Path, json_path: str | None) -> None:
    """Show the accounts and their roles."""
    path, accounts = _accounts(file, config_path)
    write_json(json_path, {"accounts": [{"name": each.name, "role": str(each.role)} for each in accounts.values()]})
    if json_path is not None:
        return
    for each in accounts.values():
        click.echo(f"{each.role:9} {each.name}")
    if not accounts:
        click.echo(f"{path}: there is no account; `toolpoint users add NAME --role operator` makes one")


@users.command()
@click.argument("name")
@file_option
@config_option
def remove(name: str, file: Path | None, config_path: Path) -> None:
    """Take the account NAME away; whoever is logged in with it is logged out."""
    from daemon.monitor.accounts import write_accounts

    path, accounts = _accounts(file, config_path)
    _known(name, path, accounts)
    del accounts[name]
    write_accounts(path, accounts)
    say(f"{path}: {name} may log in no longer")


@users.command()
@click.argument("name")
@password_option
@file_option
@config_option
def password(name: str, password_file: TextIO | None, file: Path | None, config_path: Path) -> None:
    """Change the password of NAME; whoever is logged in with the old one is logged out."""
    from daemon.monitor.accounts import hashed, write_accounts

    path, accounts = _accounts(file, config_path)
    _known(name, path, accounts)
    accounts[name] = replace(accounts[name], password_hash=hashed(_password(name, password_file)))
    write_accounts(path, accounts)
    say(f"{path}: {name} has a new password")


def _accounts(file: Path | None, config_path: Path) -> "tuple[Path, dict[str, Account]]":
    """Return the file and what it holds; nothing where it is not there yet."""
    from daemon.monitor.accounts import read_accounts

    path = file or read_configuration(config_path).service.users
    if path is None:
        refuse(
            f"{config_path} names no file of accounts: add `service: {{users: /etc/toolpoint/users}}`, or give --file"
        )
    return path, read_accounts(path) if path.exists() else {}


def _known(name: str, path: Path, accounts: "dict[str, Account]") -> None:
    if name not in accounts:
        refuse(f"{path}: there is no account {name}; there are {', '.join(accounts) or 'none'}", FAILED)


def _password(name: str, file: TextIO | None) -> str:
    if file is not None:
        try:
            return file.readline().rstrip("\n")
        except (OSError, UnicodeDecodeError) as error:
            why = getattr(error, "strerror", None) or "it is no text in UTF-8"
            refuse(f"{file.name}: the password cannot be read: {why}")
    if not sys.stdin.isatty():
        refuse("standard input is no terminal to ask for a password on; give --password-file -")
    answer = click.prompt(f"password of {name}", hide_input=True, confirmation_prompt=True, err=True)
    return str(answer)
