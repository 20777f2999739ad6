"""Names and addresses in the configuration: what no name can be is refused with the key, before anything is opened."""

import pytest
from pydantic import BaseModel, ValidationError

from config.schema.cnc_drivers import FocasConfig, HaasConfig, MtconnectConfig, OpcUaConfig
from config.schema.modbus import ModbusConfig
from config.schema.service import OpcUaServerConfig, ServiceConfig, ShdrConfig
from config.schema.sinks import MailConfig, PostgresqlConfig
from config.schema.source_sections import MqttConfig


@pytest.mark.parametrize("host", ["a\0b", "a b", "a\n", "", "a/b", "a@b", "x" * 254, "\x7f"])
@pytest.mark.parametrize(
    ("section", "key", "form"),
    [
        (FocasConfig, "host", "{}"),
        (HaasConfig, "host", "{}"),
        (MtconnectConfig, "url", "http://{}/x"),
        (OpcUaConfig, "endpoint", "opc.tcp://{}"),
        (ModbusConfig, "host", "{}"),
        (MqttConfig, "host", "{}"),
        (ShdrConfig, "host", "{}"),
        (OpcUaServerConfig, "host", "{}"),
        (ServiceConfig, "http_host", "{}"),
    ],
    ids=lambda value: value.__name__ if isinstance(value, type) else None,
)
def test_what_no_host_is_called_is_refused(section: type[BaseModel], key: str, form: str, host: str) -> None:
    if form != "{}" and host in ("a/b", "a@b", "x" * 254):
        return  # a path, a user or a long name may stand there
    with pytest.raises(ValidationError) as refused:
        section.model_validate({key: form.format(host)})
    assert key in {error["loc"][0] for error in refused.value.errors()}


@pytest.mark.parametrize("host", ["[::1]", "db.plant.example:5432", "192.168.10.20:8193", "tcp://broker", ":80"])
@pytest.mark.parametrize(
    "section", [FocasConfig, ModbusConfig, MqttConfig, ShdrConfig, ServiceConfig, MailConfig, PostgresqlConfig]
)
def test_a_port_or_brackets_in_a_host_are_refused_and_not_looked_up_as_a_name(
    section: type[BaseModel], host: str
) -> None:
    key = "http_host" if section is ServiceConfig else "host"
    with pytest.raises(ValidationError) as refused:
        section.model_validate({key: host})
    assert (key,) in {error["loc"] for error in refused.value.errors()}


@pytest.mark.parametrize(
    "host",
    [
        "::",
        "2001:db8::17",
        "::ffff:10.0.0.1",
        "localhost",
        "192.168.10.20",
        "::1",
        "fe80::1%eth0",
        "cnc-1.shop",
        "münchen.example",
    ],
)
def test_hosts_that_there_are_are_taken(host: str) -> None:
    assert FocasConfig(host=host).host == host


@pytest.mark.parametrize("host", ["/run/postgresql", "@abstract", "db.plant.example", "::1"])
def test_a_database_may_also_be_behind_a_socket_of_this_computer(host: str) -> None:
    assert PostgresqlConfig(host=host).host == host
