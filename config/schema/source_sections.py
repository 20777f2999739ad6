"""Sections of the temperature sources: logger files, the kernel's sensors, lines of a program, MQTT, OPC UA tags.

Each wire stands apart from its list of sensors, because displacements come over the same wires.
"""

from datetime import UTC, datetime
from pathlib import Path
from typing import ClassVar, Literal
from zoneinfo import ZoneInfo

from pydantic import Field

from config.schema.base import (
    ENDPOINT_PATTERN,
    TOPIC_PATTERN,
    Host,
    Problems,
    Seconds,
    Section,
    TlsAccount,
    checked,
    repeated,
)
from config.schema.cnc_drivers import OpcUaSecurityConfig
from config.schema.sources import Measured, SourceConnection, SourceSensorConfig


class LoggerFileConfig(Section):
    """The CSV files that a logger writes."""

    path: Path = Field(
        description="the file, or a pattern such as /srv/logger/*.csv (the newest is followed)",
        examples=["/srv/logger/*.csv"],
    )
    encoding: Literal["utf-8", "utf-8-sig", "cp932", "latin-1", "cp1252"] = Field("utf-8-sig", description="encoding")
    delimiter: Literal[",", ";", "\t"] = Field(",", description="between fields")
    decimal: Literal[".", ","] = Field(".", description="decimal mark")
    header: str | None = Field(
        None,
        description="text that the header row starts with; rows before it are a metadata block. "
        "None: there is no header, and columns are given by number",
        examples=["time"],
    )
    unit_row: bool = Field(False, description="the row after the header holds units")
    time_columns: list[str | int] = Field(
        default_factory=lambda: list[str | int]([1]), description="column, or date and time columns, of the time stamp"
    )
    time_format: str = Field(
        "%Y-%m-%dT%H:%M:%S",
        description="strptime format of the joined time columns (joined by one blank); %s: seconds since 1970",
    )
    time_zone: str = Field("UTC", description="IANA name of the zone of the logger's time stamps")
    overflow_tokens: list[str] = Field(
        default_factory=lambda: ["+OVER", "-OVER", "OVER", "+FFFF", "-FFFF", "----"],
        description="texts that the logger writes in place of a value",
    )
    poll_period_s: Seconds = Field(5.0, description="time between looks at size and time of the file")
    max_line_bytes: int = Field(65536, ge=256, description="a longer line is skipped and reported")

    @checked
    def _readable(self) -> Problems:
        if self.delimiter == self.decimal:
            yield ("decimal",), "delimiter and decimal mark are the same character"
        if self.header is None and any(isinstance(column, str) for column in self.time_columns):
            yield ("time_columns",), "without file.header, columns must be given by number (from 1)"
        yield from self._time_problems()
        if any(isinstance(column, int) and column < 1 for column in self.time_columns):
            yield ("time_columns",), "columns count from 1"

    def _time_problems(self) -> Problems:
        """Yield what is wrong with zone and format of the time stamps."""
        if self.time_zone != "UTC":
            try:
                ZoneInfo(self.time_zone)
            except (KeyError, ValueError, OSError):
                sentence = f"there is no time zone {self.time_zone!r} on this computer; write one such as Asia/Tokyo"
                yield ("time_zone",), sentence
        if self.time_format != "%s":
            moment = datetime(2026, 1, 31, 8, 15, 30, tzinfo=UTC)
            try:
                datetime.strptime(moment.strftime(self.time_format), self.time_format)
            except ValueError as error:
                yield ("time_format",), f"{self.time_format!r} is no strptime format: {error}"

    def column_problems(self, listed: str, columns: list[str | int]) -> Problems:
        """Yield which columns of values cannot be read, by the key of their list and their places in it."""
        for index, column in enumerate(columns):
            at = (listed, index, "column")
            if column in columns[:index]:
                yield at, f"reads the column {column!r}, which another one reads already"
            if isinstance(column, int) and column < 1:
                yield at, "columns count from 1"
            if self.header is None and isinstance(column, str):
                yield at, "without file.header, columns must be given by number (from 1)"


class CsvColumn(Measured):
    """One column of a logger's files."""

    column: str | int = Field(description="header text of its column, or the column's number from 1", examples=[2])


class CsvSensorConfig(CsvColumn, SourceSensorConfig):
    """One sensor in one column of a logger's files."""


class CsvFiles(SourceConnection):
    """The CSV files that a logger writes, followed as they grow."""

    driver: ClassVar[str] = "csv"

    file: LoggerFileConfig = Field(
        description="the files; with an empty `time_columns` a row counts from when it is read"
    )

    @checked
    def _columns(self) -> Problems:
        return self.file.column_problems(self.listed, [each.column for each in self.every_input])


class CsvConfig(CsvFiles):
    """The files of a logger of temperatures."""

    sensors: list[CsvSensorConfig] = Field(
        min_length=1, description="the sensors and their columns", examples=[[{"id": 411, "component": "Spindle unit"}]]
    )


POWER_UP_MILLIDEGC = 85000
"""What a DS18B20 holds after power-up, before its first conversion: no temperature."""


def is_one_wire(path: Path) -> bool:
    """Return whether a file of the kernel is of a sensor on a 1-Wire bus, by its folder's name."""
    return path.parent.name[:3] in {"10-", "22-", "28-", "3b-", "42-"}


class KernelFile(Measured):
    """One file of the kernel that holds one number."""

    path: Path = Field(
        description="file that holds its number, of 1-Wire as in the example, of hwmon such as "
        "/sys/class/hwmon/hwmon1/temp1_input, of IIO such as /sys/bus/iio/devices/iio:device0/in_temp_input",
        examples=["/sys/bus/w1/devices/28-0316a2796fff/temperature"],
    )


class KernelSensorConfig(KernelFile, SourceSensorConfig):
    """One sensor in one file of the kernel."""

    scale: float = Field(0.001, description="the number read is multiplied by this; the kernel counts thousandths")

    def is_open(self, number: float) -> bool:
        """Return whether a number as read is no temperature; 85.000 degC is how a 1-Wire sensor powers up."""
        return (is_one_wire(self.path) and number == POWER_UP_MILLIDEGC) or super().is_open(number)


class KernelFiles(SourceConnection):
    """Sensors that the kernel of this computer reads: 1-Wire, hwmon, IIO."""

    driver: ClassVar[str] = "kernel"

    timeout_s: Seconds = Field(5.0, description="a sensor that takes longer is not waited for")

    @checked
    def _once(self) -> Problems:
        for index, path in repeated(each.path for each in self.every_input):
            yield (self.listed, index, "path"), f"two {self.listed} read {path}"


class KernelConfig(KernelFiles):
    """Temperature sensors of the kernel."""

    sensors: list[KernelSensorConfig] = Field(
        min_length=1, description="the sensors and their files", examples=[[{"id": 421, "component": "Column"}]]
    )


class ProgramField(Measured):
    """One field of what a program writes."""

    field: str = Field(
        min_length=1,
        description="key of its number in the JSON object; `a.b` is b within a, `a.0` the first of a list",
        examples=["t1"],
    )


class FieldSensorConfig(ProgramField, SourceSensorConfig):
    """One sensor in one field of what a program writes."""


class Program(SourceConnection):
    """A program that the daemon starts, and that writes a JSON object with its numbers on each line."""

    driver: ClassVar[str] = "process"

    command: list[str] = Field(
        min_length=1,
        description='program and arguments, without a shell; it writes lines such as {"t1": 21.5, "t2": 22.0}',
        examples=[["/usr/local/bin/read-my-logger", "--json"]],
    )
    max_line_bytes: int = Field(65536, ge=256, description="a longer line is skipped and reported")


class ProcessConfig(Program):
    """A program that writes temperatures."""

    sensors: list[FieldSensorConfig] = Field(
        min_length=1, description="the sensors and their fields", examples=[[{"id": 431, "component": "Bed"}]]
    )


class MqttTopic(Measured):
    """One number in the messages of one topic."""

    topic: str = Field(
        pattern=TOPIC_PATTERN, description="topic of its messages, without wildcards", examples=["machine/column/t1"]
    )
    field: str = Field(
        "",
        description="key of its number in the message's JSON object, `a.b` is b within a, `a.0` the first of a list; "
        "empty: the message itself",
    )


class MqttSensorConfig(MqttTopic, SourceSensorConfig):
    """One sensor in the messages of one topic."""


class MqttBroker(TlsAccount, SourceConnection):
    """A broker to which devices publish."""

    driver: ClassVar[str] = "mqtt"

    host: Host = Field(description="name or address of the broker", examples=["192.168.10.40"])
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

    @property
    def exposed(self) -> str:
        """What MQTT without TLS cannot keep out."""
        return "" if self.tls else "NOT encrypted: whoever is on its network can publish in a device's name (`tls`)"

    @property
    def secrets(self) -> dict[str, Path]:
        """The password's file."""
        return {} if self.password_file is None else {"password_file": self.password_file}


class MqttConfig(MqttBroker):
    """A broker to which devices publish temperatures."""

    sensors: list[MqttSensorConfig] = Field(
        min_length=1, description="the sensors and their topics", examples=[[{"id": 441, "component": "Column"}]]
    )


class OpcUaTag(Measured):
    """One tag."""

    node: str = Field(
        min_length=1,
        description="identifier of its tag in the namespace: s=text or i=number",
        examples=["s=Temperature.1"],
    )
    element: int | None = Field(
        None,
        ge=0,
        description="place of its number in a tag that is an array, counted from 0; none: the tag is a number",
    )


class OpcUaTagSensorConfig(OpcUaTag, SourceSensorConfig):
    """One sensor in one tag."""


class OpcUaServer(SourceConnection):
    """A server whose tags hold what is measured: a control, a gateway, a logger."""

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

    @property
    def exposed(self) -> str:
        """What OPC UA without security cannot keep out."""
        return "" if self.security else "NOT encrypted: whoever is on its network can answer in its place (`security`)"

    @property
    def secrets(self) -> dict[str, Path]:
        """The password's file and the private key."""
        return {} if self.security is None else self.security.secrets


class OpcUaTagsConfig(OpcUaServer):
    """A server whose tags hold temperatures."""

    sensors: list[OpcUaTagSensorConfig] = Field(
        min_length=1, description="the sensors and their tags", examples=[[{"id": 451, "component": "Column"}]]
    )
