"""`toolpoint check` looks at certificates, keys and accounts before the daemon needs them."""

from ipaddress import ip_address
from pathlib import Path
from typing import Any

import pytest
import yaml
from certificates import make_certificate
from click.testing import CliRunner
from cryptography import x509
from cryptography.hazmat.primitives import serialization
from model_folder import open_folder
from other_user import OTHER, as_root, as_user

from config.loader import load_configuration
from config.sample import sample_configuration
from daemon.checkup.machine import ports
from daemon.cli import main
from daemon.monitor.listening import listening
from drivers.opcua.new_certificate import create_application_certificate


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Everything as it should be."""
    make_certificate(tmp_path, days=(-2, 30))
    (tmp_path / "trusted").mkdir()
    create_application_certificate(
        tmp_path / "tags.der", tmp_path / "tags.pem", application_uri="urn:mill", host_name="mill", server=True
    )
    words = ["users", "add", "anna", "--role", "viewer", "--password-file", "-", "--file", str(tmp_path / "users")]
    assert CliRunner().invoke(main, words, input="a long password\n").exit_code == 0
    return tmp_path


def check(folder: Path, **service: Any) -> tuple[int, str]:
    content = yaml.safe_load(sample_configuration())
    content["service"] |= {"tls_certificate": "monitor.crt", "tls_key": "monitor.key", "users": "users"} | service
    content["opcua_server"] = {"certificate": "tags.der", "private_key": "tags.pem", "trusted_clients": "trusted"}
    path = folder / "toolpoint.yaml"
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    ended = CliRunner().invoke(main, ["check", "--no-devices", "--config", str(path)])
    return ended.exit_code, " ".join(ended.output.split())


def test_what_can_be_used_is_found_good_and_a_credential_is_the_services_own_affair(folder: Path) -> None:
    status, output = check(folder)
    assert status == 0 and "1 may log in" in output and output.count("valid until") == 2
    status, output = check(folder, tls_key="/run/credentials/toolpoint.service/monitor-key")
    assert (
        status == 0
        and "monitor-key is handed to the service" in output
        and "for 10.0.0.17, localhost, mill-7" in output
    )


@pytest.mark.parametrize(
    ("place", "status", "sentence"),
    [
        ("history.sqlite", 0, "ok history:"),
        ("missing/folder/history.sqlite", 0, "not yet history: history.path: the folder"),
        ("users/history.sqlite", 1, "users is no folder"),
        ("trusted", 1, "trusted is a folder; name a file in it"),
        ("a" * 300 + "/history.sqlite", 1, "history.path: File name too long"),
    ],
)
def test_where_the_history_cannot_lie_is_said_before_the_daemon_starts(
    folder: Path, place: str, status: int, sentence: str
) -> None:
    content = yaml.safe_load(sample_configuration())
    content["history"]["path"] = place
    path = folder / "machine.yaml"
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    ended = CliRunner().invoke(main, ["check", "--no-devices", "--config", str(path)])
    assert (ended.exit_code, sentence in " ".join(ended.output.split())) == (status, True), ended.output
    assert not (folder / "missing").exists(), "a check makes nothing"


@as_root
def test_a_check_by_another_user_than_the_services_goes_past_the_folder_that_is_closed_to_him() -> None:
    with open_folder() as folder:
        (folder / "state").mkdir(mode=0o700)
        content = yaml.safe_load(sample_configuration())
        content["history"]["path"] = "state/history.sqlite"
        path = folder / "machine.yaml"
        path.write_text(yaml.safe_dump(content), encoding="utf-8")
        words = ["check", "--no-devices", "--config", str(path)]
        output = as_user(OTHER, lambda: CliRunner().invoke(main, words).output)
        assert "closed to this user" in " ".join(output.split()), output
        assert CliRunner().invoke(main, words).exit_code == 0


SERVED = ("monitor.crt", "monitor.key", "users", "tags.der", "tags.pem", "trusted/plc.der")


@pytest.mark.parametrize(
    ("name", "damage"), [*((name, "half") for name in SERVED), ("monitor.key", "folder"), ("users", "folder")]
)
def test_what_is_damaged_is_named(folder: Path, name: str, damage: str) -> None:
    path = folder / name
    content = path.read_bytes() if path.exists() else b"no certificate"
    path.unlink(missing_ok=True)
    if damage == "folder":
        path.mkdir()
    else:
        path.write_bytes(content[: len(content) // 2])
        path.chmod(0o640)
    status, output = check(folder)
    assert status == 1 and f"{path}" in output and output.count("FAIL") == 1


def test_a_certificate_that_has_expired_or_has_another_key_is_named(folder: Path) -> None:
    make_certificate(folder, days=(-9, -1))
    status, output = check(folder)
    assert status == 1 and f"{folder}/monitor.crt is valid from" in output
    key = (folder / "monitor.key").read_bytes()
    make_certificate(folder)
    (folder / "monitor.key").write_bytes(key)
    status, output = check(folder)
    assert status == 1 and f"{folder}/monitor.key is not the private key of {folder}/monitor.crt" in output
    assert "_ssl.c" not in output and "Errno" not in output
    (folder / "monitor.key").unlink()
    status, output = check(folder)
    assert status == 1 and "monitor.crt cannot be read (No such file or directory)" in output


ADDRESS = x509.IPAddress(ip_address("10.0.0.17"))


@pytest.mark.parametrize(
    ("names", "service", "sentence"),
    [
        ([], {}, "carries no name (subjectAltName)"),
        ([x509.DNSName("mill-7.hall")], {"http_host": "mill-8.hall"}, "not for service.http_host, mill-8.hall"),
        ([ADDRESS], {"http_host": "10.0.0.18"}, "none of which is service.http_host, 10.0.0.18"),
        ([x509.DNSName("mill-7.hall")], {"http_host": "Mill-7.hall"}, ""),
        ([x509.DNSName("*.hall")], {"http_host": "mill-8.hall"}, ""),
        ([x509.DNSName("mill-7.hall")], {"http_host": "10.0.0.18"}, ""),
        ([ADDRESS], {"http_host": "10.0.0.17"}, ""),
        ([ADDRESS], {"http_host": "0.0.0.0"}, ""),
        ([x509.DNSName("plant")], {"http_host": "mill-8.hall", "trusted_proxies": ["10.0.0.1"]}, ""),
        ([x509.DNSName("plant")], {}, ""),
    ],
)
@pytest.mark.parametrize("key", ["monitor.key", "/run/credentials/toolpoint.service/monitor-key"])
def test_a_certificate_for_other_names_than_the_monitors_is_named(
    folder: Path, names: list[x509.GeneralName], service: dict[str, Any], sentence: str, key: str
) -> None:
    make_certificate(folder, names=names)
    status, output = check(folder, tls_key=key, **service)
    assert (status, sentence in output) == (1 if sentence else 0, True), output
    assert f"{folder}/monitor.crt" in output


def test_a_key_with_a_passphrase_is_told_from_the_key_of_another_certificate(folder: Path) -> None:
    key = serialization.load_pem_private_key((folder / "monitor.key").read_bytes(), None)
    closed = serialization.BestAvailableEncryption(b"a passphrase")
    for form in (serialization.PrivateFormat.PKCS8, serialization.PrivateFormat.TraditionalOpenSSL):
        (folder / "monitor.key").write_bytes(key.private_bytes(serialization.Encoding.PEM, form, closed))
        status, output = check(folder)
        assert status == 1 and f"{folder}/monitor.key has a passphrase, which nobody is there to type" in output


def with_sinks(folder: Path, *sinks: dict[str, Any]) -> tuple[int, str]:
    content = yaml.safe_load(sample_configuration()) | {"sinks": list(sinks)}
    path = folder / "machine.yaml"
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    ended = CliRunner().invoke(main, ["check", "--no-devices", "--config", str(path)])
    return ended.exit_code, " ".join(ended.output.split())


@pytest.mark.parametrize(
    ("section", "sentence"),
    [
        ({"driver": "mqtt", "mqtt": {"host": "b", "user_name": "u", "password_file": "missing"}}, "`password_file`"),
        ({"driver": "postgresql", "postgresql": {"host": "db", "ca_certificate": "missing"}}, "`ca_certificate`"),
        ({"driver": "postgresql", "postgresql": {"host": "db", "ca_certificate": "monitor.key"}}, "in PEM"),
        ({"driver": "webhook", "webhook": {"url_file": "trusted"}}, "`url_file`"),
        ({"driver": "parquet", "parquet": {"folder": "/missing/folder"}}, "/missing/folder: there is no such folder"),
        (
            {"driver": "parquet", "parquet": {"folder": "s3://plant/x?regoin=eu-central-1"}},
            "parameter in S3 URI: 'regoin'",
        ),
        ({"driver": "parquet", "parquet": {"folder": "s3://K:S/T@plant/x"}}, "in a key, / is written %2F"),
    ],
)
def test_what_a_sink_needs_and_does_not_find_is_named_before_it_runs(
    folder: Path, section: dict[str, Any], sentence: str
) -> None:
    status, output = with_sinks(folder, {"name": "plant"} | section)
    assert status == 1 and "FAIL sink plant:" in output and sentence in output, output


def test_a_sink_whose_files_are_there_is_found_good_and_its_server_is_not_asked(folder: Path) -> None:
    secret = {"user_name": "u", "password_file": "/run/credentials/toolpoint-sink.service/mqtt-password"}
    status, output = with_sinks(
        folder,
        {
            "name": "hall",
            "driver": "mqtt",
            "mqtt": {"host": "broker.invalid", "ca_certificate": "monitor.crt"} | secret,
        },
        {"name": "plant", "driver": "postgresql", "postgresql": {"host": "192.0.2.1", "tls": False}},
    )
    assert status == 0, output
    assert "ok sink hall: broker.invalid:8883/toolpoint, not asked" in output and "is handed to the service" in output
    assert "ok sink plant: 192.0.2.1:5432/toolpoint, not asked; NOT encrypted" in output


@pytest.mark.parametrize(
    ("host", "words"), [("127.0.0.1", "is taken by another program"), ("192.0.2.1", "is no address of this computer")]
)
def test_a_port_that_cannot_be_served_is_found_before_the_daemon_starts(host: str, words: str, tmp_path: Path) -> None:
    content = yaml.safe_load(sample_configuration())
    path = tmp_path / "machine.yaml"
    with listening("127.0.0.1", 0, 1) as taken:
        content["service"]["http_port"] = taken.getsockname()[1]
        content["shdr"] = {"host": host, "port": taken.getsockname()[1]}
        path.write_text(yaml.safe_dump(content), encoding="utf-8")
        http, shdr = ports(load_configuration(path))
    assert (http.subject, shdr.subject) == ("service.http_port", "shdr.port")
    assert http.failed and "ss -ltnp" in http.detail
    assert shdr.failed and words in shdr.detail
    http, *_ = ports(load_configuration(path))
    assert http.passed and http.detail.endswith("is free")
