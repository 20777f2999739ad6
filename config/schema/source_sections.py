"""Sections of the temperature sources: logger files, the kernel's sensors, lines of a program, MQTT, OPC UA tags."""

from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar, Self

from pydantic import Field, model_validator

from config.schema.base import ENDPOINT_PATTERN, TOPIC_PATTERN, KeyPath, KeyProblems, Seconds
from config.schema.cnc_drivers import OpcUaSecurityConfig
from config.schema.logger_file import LoggerFileConfig
from config.schema.sources import SourceConnection, SourceSensorConfig


class CsvSensorConfig(SourceSensorConfig):
    """One sensor in one column of a logger's files."""

    column: str | int = Field(description="header text of its column, or the column's number from 1", examples=[2])


class CsvConfig(SourceConnection):
    """The CSV files that a logger writes, followed as they grow."""

    driver: ClassVar[str] = "csv"

    file: LoggerFileConfig = Field(
        description="the files; with an empty `time_columns` a row counts from when it is read"
    )
    sensors: list[CsvSensorConfig] = Field(
        min_length=1,
        description="the sensors and their columns",
        examples=[[{"id": 411, "component": "Spindle unit"}]],
    )

    @model_validator(mode="after")
    def _columns(self) -> Self:
        found = self.file.column_problems([sensor.column for sensor in self.sensors])
        if found:
            raise KeyProblems([(("sensors", index, "column"), sentence) for index, sentence in found])
        return self

    @property
    def every_sensor(self) -> Sequence[CsvSensorConfig]:
        """The sensors, in the order of the section."""
        return self.sensors


POWER_UP_MILLIDEGC = 85000
"""What a DS18B20 holds after power-up, before its first conversion: no temperature."""


class KernelSensorConfig(SourceSensorConfig):
    """One sensor in one file of the kernel."""

    path: Path = Field(
        description="file that holds its number in thousandths of a degree, of 1-Wire as in the example, of hwmon such "
        "as /sys/class/hwmon/hwmon1/temp1_input, of IIO such as /sys/bus/iio/devices/iio:device0/in_temp_input",
        examples=["/sys/bus/w1/devices/28-0316a2796fff/temperature"],
    )
    scale: float = Field(0.001, description="the number read is multiplied by this; the kernel counts thousandths")

    @property
    def is_one_wire(self) -> bool:
        """Whether it hangs on a 1-Wire bus, by its folder's name."""
        return self.path.parent.name[:3] in {"10-", "22-", "28-", "3b-", "42-"}

    def is_open(self, number: float) -> bool:
        """Return whether a number as read is no temperature; 85.000 degC is how a 1-Wire sensor powers up."""
        return (self.is_one_wire and number == POWER_UP_MILLIDEGC) or super().is_open(number)


class KernelConfig(SourceConnection):
    """Sensors that the kernel of this computer reads: 1-Wire, hwmon, IIO."""

    driver: ClassVar[str] = "kernel"

    timeout_s: Seconds = Field(5.0, description="a sensor that takes longer is not waited for")
    sensors: list[KernelSensorConfig] = Field(
        min_length=1, description="the sensors and their files", examples=[[{"id": 421, "component": "Column"}]]
    )

    @model_validator(mode="after")
    def _once(self) -> Self:
        paths = [sensor.path for sensor in self.sensors]
        problems: list[tuple[KeyPath, str]] = [
            (("sensors", index, "path"), f"two sensors read {path}")
            for index, path in enumerate(paths)
            if path in paths[:index]
        ]
        if problems:
            raise KeyProblems(problems)
        return self

    @property
    def every_sensor(self) -> Sequence[KernelSensorConfig]:
        """The sensors, in the order of the section."""
        return self.sensors


class FieldSensorConfig(SourceSensorConfig):
    """One sensor in one field of what a program writes."""

    field: str = Field(
        min_length=1, description="key of its number in the JSON object; `a.b` is b within a", examples=["t1"]
    )


class ProcessConfig(SourceConnection):
    """A program that the daemon starts, and that writes a JSON object with its sensors' numbers on each line."""

    driver: ClassVar[str] = "process"

    command: list[str] = Field(
        min_length=1,
        description='program and arguments, without a shell; it writes lines such as {"t1": 21.5, "t2": 22.0}',
        examples=[["/usr/local/bin/read-my-logger", "--json"]],
    )
    max_line_bytes: int = Field(65536, ge=256, description="a longer line is skipped and reported")
    sensors: list[FieldSensorConfig] = Field(
        min_length=1, description="the sensors and their fields", examples=[[{"id": 431, "component": "Bed"}]]
    )

    @property
    def every_sensor(self) -> Sequence[FieldSensorConfig]:
        """The sensors, in the order of the section."""
        return self.sensors


class MqttSensorConfig(SourceSensorConfig):
    """One sensor in the messages of one topic."""

    topic: str = Field(
        pattern=TOPIC_PATTERN, description="topic of its messages, without wildcards", examples=["machine/column/t1"]
    )
    field: str = Field(
        "", description="key of its number in the message's JSON object, `a.b` is b within a; empty: the message itself"
    )


class MqttConfig(SourceConnection):
    """A broker to which devices publish."""

    driver: ClassVar[str] = "mqtt"

    host: str = Field(min_length=1, description="name or address of the broker", examples=["192.168.10.40"])
    port: int = Field(1883, ge=1, le=65535, description="its TCP port; with TLS mostly 8883")
    user_name: str | None = Field(None, description="user at the broker", examples=["toolpoint"])
    password_file: Path | None = Field(
        None,
        description="file that holds the password, readable by the daemon only",
        examples=["/run/credentials/toolpoint.service/mqtt-password"],
    )
    tls: bool = Field(False, description="encrypt, and accept only a broker whose certificate is vouched for")
    ca_certificate: Path | None = Field(
        None,
        description="certificate (PEM) that vouches for the broker's; left out, those of this computer do",
        examples=["/etc/toolpoint/pki/broker-ca.pem"],
    )
    timeout_s: Seconds = Field(5.0, description="connecting and subscribing may take so long")
    sensors: list[MqttSensorConfig] = Field(
        min_length=1, description="the sensors and their topics", examples=[[{"id": 441, "component": "Column"}]]
    )

    @model_validator(mode="after")
    def _password_with_user(self) -> Self:
        if self.password_file is not None and self.user_name is None:
            raise KeyProblems([(("user_name",), "a password needs a user name")])
        if self.ca_certificate is not None and not self.tls:
            raise KeyProblems([(("tls",), "ca_certificate is of use with `tls: true` only")])
        return self

    @property
    def every_sensor(self) -> Sequence[MqttSensorConfig]:
        """The sensors, in the order of the section."""
        return self.sensors

    @property
    def exposed(self) -> str:
        """What MQTT without TLS cannot keep out."""
        return "" if self.tls else "NOT encrypted: whoever is on its network can publish in a device's name (`tls`)"

    @property
    def secrets(self) -> dict[str, Path]:
        """The password's file."""
        return {} if self.password_file is None else {"password_file": self.password_file}


class OpcUaTagSensorConfig(SourceSensorConfig):
    """One sensor in one tag."""

    node: str = Field(
        min_length=1,
        description="identifier of its tag in the namespace: s=text or i=number",
        examples=["s=Temperature.1"],
    )


class OpcUaTagsConfig(SourceConnection):
    """A server whose tags hold temperatures: a control, a gateway, a logger."""

    driver: ClassVar[str] = "opcua"

    endpoint: str = Field(
        pattern=ENDPOINT_PATTERN,
        description="address of the server: opc.tcp://host:port/path",
        examples=["opc.tcp://192.168.10.50:4840/gateway"],
    )
    namespace_uri: str = Field(min_length=1, description="namespace of the tags", examples=["urn:gateway:temperatures"])
    security: OpcUaSecurityConfig | None = Field(
        None, description="Basic256Sha256, sign and encrypt, with a user; without it nothing is encrypted"
    )
    timeout_s: Seconds = Field(5.0, description="an answer that takes longer is not waited for")
    sensors: list[OpcUaTagSensorConfig] = Field(
        min_length=1, description="the sensors and their tags", examples=[[{"id": 451, "component": "Column"}]]
    )

    @property
    def every_sensor(self) -> Sequence[OpcUaTagSensorConfig]:
        """The sensors, in the order of the section."""
        return self.sensors

    @property
    def exposed(self) -> str:
        """What OPC UA without security cannot keep out."""
        return "" if self.security else "NOT encrypted: whoever is on its network can answer in its place (`security`)"

    @property
    def secrets(self) -> dict[str, Path]:
        """The password's file and the private key."""
        if self.security is None:
            return {}
        return {f"security.{key}": getattr(self.security, key) for key in ("password_file", "private_key")}
