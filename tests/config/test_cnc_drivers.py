"""The driver of the CNC decides which section is read; what does not fit is refused at its key."""

from pathlib import Path
from typing import ClassVar, Literal

import jsonschema
import pytest
from pydantic import Field, ValidationError
from scripted_machine import cnc_config

from config.loader import ConfigurationError, parse_yaml_model
from config.schema.base import drivers_of
from config.schema.cnc import CncConfig
from config.schema.cnc_drivers import CncConnection, CncDriverConfig, OpcUaConfig

OPCUA = "opcua:\n  endpoint: opc.tcp://192.0.2.1:4840/cnc\n  namespace_uri: urn:cnc\n"


class OtherConfig(CncConnection):
    """A second driver, without encryption."""

    driver: ClassVar[str] = "other"

    host: str = Field(description="name or address of the control")


class TwoDrivers(CncDriverConfig):
    """What a second driver adds to the schema."""

    driver: Literal["opcua", "other"] = Field("opcua", description="which")
    other: OtherConfig | None = Field(None, description="the other one; required with driver other")


def refusal(text: str) -> str:
    with pytest.raises(ConfigurationError) as refused:
        parse_yaml_model(text, TwoDrivers, "f.yaml")
    (problem,) = refused.value.problems
    return str(problem)


def test_without_driver_the_section_of_opc_ua_is_read() -> None:
    config = parse_yaml_model(OPCUA, TwoDrivers, "f.yaml")
    assert (config.driver, type(config.connection)) == ("opcua", OpcUaConfig)


def test_the_driver_decides_which_section_is_read() -> None:
    config = parse_yaml_model("driver: other\nother: {host: cnc1}\n", TwoDrivers, "f.yaml")
    assert config.connection_as(OtherConfig).host == "cnc1"
    with pytest.raises(TypeError, match="for driver other, not opcua"):
        config.connection_as(OpcUaConfig)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("driver: other\n", "f.yaml:1:1: other: this key is required and missing: the other one"),
        (f"driver: other\n{OPCUA}other: {{host: a}}\n", "f.yaml:2:1: opcua: this section is for driver opcua, but"),
        ("driver: othr\nother: {host: a}\n", "f.yaml:1:9: driver: this must be one of 'opcua', 'other' (did you mean"),
        ("driver: other\nother: {hots: a, host: b}\n", "f.yaml:2:9: other.hots: unknown key; did you mean `host`?"),
        ("driver: other\nother: {}\n", "f.yaml:2:1: other.host: this key is required and missing: name or address"),
        ("driver: other\nother: {host: 5}\n", "f.yaml:2:15: other.host: this must be text, not 5"),
    ],
)
def test_what_does_not_fit_is_refused_with_file_line_and_key(text: str, sentence: str) -> None:
    assert refusal(text).startswith(sentence)


def test_json_schema_asks_for_the_section_of_the_driver_alone() -> None:
    validator = jsonschema.Draft202012Validator(TwoDrivers.model_json_schema())
    opcua = {"endpoint": "opc.tcp://192.0.2.1:4840", "namespace_uri": "urn:cnc"}
    assert validator.is_valid({"opcua": opcua})
    assert validator.is_valid({"driver": "other", "other": {"host": "a"}})
    assert not validator.is_valid({})
    assert not validator.is_valid({"driver": "other", "opcua": opcua})
    assert not validator.is_valid({"driver": "other", "other": {"host": "a"}, "opcua": opcua})


def test_a_driver_that_cannot_encrypt_says_so() -> None:
    config = TwoDrivers(driver="other", other=OtherConfig(host="a"))
    assert not config.connection.encrypted
    assert config.insecure_advice == (
        "driver other cannot encrypt; on a wire of its own, set cnc.allow_insecure_writes: true"
    )


def test_a_driver_that_only_reads_is_not_advised_to_allow_writes() -> None:
    section = {"url": "http://192.0.2.1:5000"}
    for changes in ({}, {"allow_insecure_writes": True}):
        advice = cnc_config(mtconnect=section, **changes).insecure_advice
        assert "allow" not in advice and "another driver (cnc.driver)" in advice


def test_secrets_are_named_by_their_keys_and_can_lie_elsewhere() -> None:
    security = {
        "user_name": "u",
        "password_file": Path("/a/password"),
        "certificate": Path("/a/own.der"),
        "private_key": Path("/a/own.pem"),
        "server_certificate": Path("/a/cnc.der"),
    }
    section = OpcUaConfig.model_validate(
        {"endpoint": "opc.tcp://192.0.2.1:4840", "namespace_uri": "urn:cnc", "security": security}
    )
    assert section.encrypted
    assert section.secrets == {
        "security.password_file": Path("/a/password"),
        "security.private_key": Path("/a/own.pem"),
    }
    moved = section.with_secrets({key: Path("/b") / path.name for key, path in section.secrets.items()})
    assert moved.security is not None and section.security is not None
    assert (moved.security.password_file, moved.security.private_key) == (Path("/b/password"), Path("/b/own.pem"))
    assert moved.security.certificate == section.security.certificate


def test_every_section_names_its_driver() -> None:
    for model in (CncDriverConfig, TwoDrivers):
        for driver in drivers_of(model):
            assert driver in model.model_fields


def test_values_in_inches_do_not_fit_the_six_decimals_of_a_haas_and_are_refused() -> None:
    macros = cnc_config(focas={"host": "x"}).macros.model_dump(exclude_none=True)
    assert all(round(nm / 1e6, 6) * 1e6 == pytest.approx(nm, abs=1e-6) for nm in range(0, 30_000, 77))
    inches = [round(nm / 25.4e6, 6) * 25.4e6 for nm in range(77, 30_000, 77)]
    assert not all(abs(nm - round(nm / 77) * 77) < 0.5 for nm in inches), "the guard would make another check"
    for driver, refused in {"focas": False, "haas": True}.items():
        said = {"driver": driver, driver: {"host": "x"}, "macros": macros | {"unit_um": 25_400.0}}
        if refused:
            with pytest.raises(ValidationError, match=r"at most 1000 \(mm\): a Haas takes six decimals"):
                CncConfig.model_validate(said)
        else:
            CncConfig.model_validate(said)
