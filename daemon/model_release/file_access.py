"""Says whether the daemon could change a file: a model that it could change protects against nothing."""

import os
import stat
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

MOST_LINKS = 40
"""Symbolic links that are followed, as the kernel does."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Account:
    """A user of this computer and the groups that count for it."""

    user_id: int | None
    """None: nobody in particular, so that only what everybody may do counts."""
    group_ids: frozenset[int] = frozenset()
    is_this_process: bool = False
    """The kernel can be asked, which knows access lists, capabilities and read-only mounts."""


def own_account() -> Account:
    return Account(user_id=os.geteuid(), group_ids=frozenset({os.getegid(), *os.getgroups()}), is_this_process=True)


def account_of_daemon(store: Path) -> Account:
    """Return the account that the daemon runs under, as far as the folder of its store tells: nobody where it does not.

    A daemon that runs as root is not found here; it refuses its model itself.
    """
    try:
        folder = store.parent.stat()
    except OSError:
        return Account(user_id=None)
    if folder.st_uid == 0:
        return Account(user_id=None)
    if folder.st_uid == os.geteuid():
        return own_account()
    return Account(user_id=folder.st_uid, group_ids=frozenset({folder.st_gid}))


def how_it_could_change(path: Path, account: Account) -> str:
    """Return how this account could change or replace a file, '' when it cannot.

    The file, its folder and every folder above count, on both sides of symbolic links: whoever may
    write one of them can put another file there. The file itself need not be there yet.
    """
    if account.user_id == 0:
        return "it runs as root, who may write everything; run it as the service's own user"
    for file in _links(path):
        if file.is_symlink() or not file.exists():
            continue
        if how := _rights(file, account):
            return f"{file} {how}"
    for folder, child in _folders(path):
        how = _rights(folder, account)
        if how and (folder in _direct(path) or not _is_foreign_sticky(folder, child, account)):
            return f"the folder {folder} {how}"
    return ""


def _links(path: Path) -> Iterator[Path]:
    """Yield a file and what its symbolic links lead to, one after the other."""
    current = path.absolute()
    for _ in range(MOST_LINKS):
        yield current
        if not current.is_symlink():
            return
        current = Path(os.path.normpath(current.parent / current.readlink()))


def _direct(path: Path) -> set[Path]:
    return {file.parent for file in _links(path)} | {Path(os.path.realpath(path)).parent}


def _folders(path: Path) -> Iterator[tuple[Path, Path]]:
    """Yield each folder that leads to a file, with what lies in it on that way."""
    seen: set[Path] = set()
    for file in (*_links(path), Path(os.path.realpath(path))):
        child = file
        for folder in file.parents:
            if folder not in seen:
                seen.add(folder)
                yield folder, child
            child = folder


def _rights(place: Path, account: Account) -> str:
    """Return what the account may do with a file or folder in words, '' when nothing that changes it."""
    found = place.stat()
    if account.is_this_process:
        if os.statvfs(place).f_flag & os.ST_RDONLY:
            return ""
        if found.st_uid == account.user_id:
            return "belongs to it"
        return "is writable by it" if os.access(place, os.W_OK, effective_ids=True) else ""
    if found.st_uid == account.user_id:
        return "belongs to it"
    if found.st_mode & stat.S_IWGRP and found.st_gid in account.group_ids:
        return "is writable by its group"
    return "is writable by everybody" if found.st_mode & stat.S_IWOTH else ""


def _is_foreign_sticky(folder: Path, child: Path, account: Account) -> bool:
    """Say whether a shared folder such as /tmp keeps the account from replacing what lies in it."""
    found = folder.stat()
    owners = {found.st_uid, child.lstat().st_uid}
    return bool(found.st_mode & stat.S_ISVTX) and account.user_id not in owners
