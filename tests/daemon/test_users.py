"""The accounts of the monitor: the file, the command that makes it, and what neither takes."""

import json
import stat

import pytest
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st

from daemon.cli import main
from daemon.monitor.accounts import Accounts, AccountsError, Role, read_accounts, verified

PASSWORD = "correct horse battery"
HASH = f"$argon2id$v=19$m=9216,t=4,p=1${'c2FsdA' * 4}${'aGFzaA' * 7}"


def users(*words, password=PASSWORD):
    return CliRunner().invoke(main, ["users", *map(str, words)], input=f"{password}\n")


def added(path, name, role="operator", password=PASSWORD):
    return users("add", name, "--role", role, "--password-file", "-", "--file", path, password=password)


def test_an_account_is_made_listed_changed_and_removed(tmp_path):
    path = tmp_path / "users"
    assert added(path, "anna").exit_code == 0
    assert added(path, "otto", "viewer").exit_code == 0
    assert stat.S_IMODE(path.stat().st_mode) == 0o640
    assert PASSWORD not in path.read_text()
    accounts = read_accounts(path)
    assert {name: each.role for name, each in accounts.items()} == {"anna": Role.OPERATOR, "otto": Role.VIEWER}
    assert verified(accounts["anna"].password_hash, PASSWORD)
    assert not verified(accounts["anna"].password_hash, PASSWORD + "!")
    listed = users("list", "--json", "-", "--file", path)
    assert json.loads(listed.stdout)["accounts"] == [
        {"name": "anna", "role": "operator"},
        {"name": "otto", "role": "viewer"},
    ]
    changed = users("password", "anna", "--password-file", "-", "--file", path, password="another long one")
    assert changed.exit_code == 0
    assert verified(read_accounts(path)["anna"].password_hash, "another long one")
    assert users("remove", "anna", "--file", path).exit_code == 0
    assert list(read_accounts(path)) == ["otto"]


@pytest.mark.parametrize(
    ("words", "status", "sentence"),
    [
        (("add", "a:b", "--role", "viewer"), 2, "is no name of an account"),
        (("add", "anna", "--role", "viewer"), 1, "there is an account anna already"),
        (("remove", "otto"), 1, "there is no account otto; there are anna"),
        (("password", "otto"), 1, "there is no account otto"),
    ],
)
def test_what_cannot_be_is_refused_with_a_sentence(tmp_path, words, status, sentence):
    path = tmp_path / "users"
    added(path, "anna")
    before = path.read_bytes()
    extra = [] if words[0] == "remove" else ["--password-file", "-"]
    answer = users(*words, *extra, "--file", path)
    assert (answer.exit_code, sentence in answer.stderr) == (status, True), answer.stderr
    assert path.read_bytes() == before


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("anna:boss:$argon2id$v=19$x\n", "'boss' is no role"),
        ("anna:viewer:plain\n", "not hashed with Argon2id"),
        ("a b:viewer:$argon2id$\n", "is no name of an account"),
        (f"anna:viewer:{HASH[:40]}\n", "not hashed with Argon2id"),
        (f"anna:viewer:{HASH}\nanna:viewer:{HASH}\n", "line 2: anna is there twice"),
        ("anna\n", "'' is no role"),
    ],
)
def test_a_file_that_is_wrong_lets_nobody_in_and_says_in_which_line(tmp_path, text, sentence):
    path = tmp_path / "users"
    path.write_text(text)
    path.chmod(0o600)
    with pytest.raises(AccountsError, match=r"line [12]") as refused:
        read_accounts(path)
    assert sentence in str(refused.value)
    accounts = Accounts(path)
    assert accounts.now() == {} and sentence in accounts.problem


def test_a_file_that_everybody_may_read_is_refused(tmp_path):
    path = tmp_path / "users"
    added(path, "anna")
    path.chmod(0o644)
    with pytest.raises(AccountsError, match="chmod o-rwx"):
        read_accounts(path)


def test_a_change_of_the_file_is_taken_up(tmp_path):
    path = tmp_path / "users"
    added(path, "anna")
    accounts = Accounts(path)
    assert set(accounts.now()) == {"anna"}
    added(path, "otto")
    assert set(accounts.now()) == {"anna", "otto"}
    path.unlink()
    assert accounts.now() == {} and "cannot be read" in accounts.problem


@given(st.text())
def test_no_text_is_taken_for_an_account_that_it_does_not_hold(tmp_path_factory, text):
    path = tmp_path_factory.mktemp("users") / "users"
    path.write_bytes(text.encode("utf-8", "surrogatepass"))
    path.chmod(0o600)
    try:
        accounts = read_accounts(path)
    except AccountsError as error:
        assert str(path) in str(error)
        return
    assert all(each.password_hash.startswith("$argon2id$") for each in accounts.values())


def test_a_byte_order_mark_before_a_password_is_none_of_it(tmp_path):
    """An editor of Windows puts it there, and nobody could log in with the password that is seen."""
    path, file = tmp_path / "users", tmp_path / "password"
    added(path, "anna")
    file.write_bytes(b"\xef\xbb\xbf" + b"another long one\r\n")
    assert users("password", "anna", "--password-file", file, "--file", path).exit_code == 0
    assert verified(read_accounts(path)["anna"].password_hash, "another long one")


def test_a_password_that_is_no_text_is_refused_with_a_sentence(tmp_path):
    path = tmp_path / "users"
    added(path, "anna")
    (tmp_path / "password").write_bytes("a long pässword\n".encode("cp1252"))
    answer = users("password", "anna", "--password-file", tmp_path / "password", "--file", path)
    assert answer.exit_code == 2 and f"{tmp_path / 'password'}: the password cannot be read" in answer.output
