"""Do something as another user of this computer; only root can."""

import os
from collections.abc import Callable

import pytest

OTHER = 54321
"""A user whom nobody is."""
as_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root can turn into another user")


def as_user(user_id: int, work: Callable[[], str]) -> str:
    """Return what `work` returns, or the text of its error, done by another user in a process of its own."""

    def turned() -> str:
        os.setresgid(user_id, user_id, user_id)
        os.setresuid(user_id, user_id, user_id)
        return work()

    return in_child(turned)


def in_child(work: Callable[[], str]) -> str:
    """Return what `work` returns, or the text of its error, done in a process of its own without further groups."""
    receive, send = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            os.setgroups([])
            os.write(send, work().encode())
        except BaseException as error:
            os.write(send, repr(error).encode())
        finally:
            os._exit(0)
    os.close(send)
    os.waitpid(child, 0)
    answer = os.read(receive, 65536).decode()
    os.close(receive)
    return answer
