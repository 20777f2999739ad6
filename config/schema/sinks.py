"""Systems of others to which the history goes."""

from pathlib import Path
from typing import Literal, Self, get_args

from pydantic import Field, model_validator

from config.schema.base import FOLDER_OR_BUCKET_PATTERN, TOPIC_PATTERN, Host, KeyProblems, Name, Seconds, Section
from config.schema.driver_section import SectionOfDriver


class PostgresqlConfig(Section):
    """A PostgreSQL database, 13 or newer, with or without TimescaleDB."""

    host: str = Field(min_length=1, description="name or address of the server", examples=["192.168.10.50"])
    port: int = Field(5432, ge=1, le=65535, description="its TCP port")
    database: str = Field("toolpoint", min_length=1, description="name of the database, which must be there")
    user_name: str = Field("toolpoint", min_length=1, description="role that may create tables in the database")
    password_file: Path | None = Field(
        None,
        description="file that holds the password, readable by the service only",
        examples=["/run/credentials/toolpoint-sink.service/database-password"],
    )
    tls: bool = Field(True, description="encrypt, and accept only a server whose certificate is vouched for")
    ca_certificate: Path | None = Field(
        None,
        description="certificate (PEM) that vouches for the server's; left out, those of this computer do",
        examples=["/etc/toolpoint/pki/database-ca.pem"],
    )
    timeout_s: Seconds = Field(10.0, description="connecting may take so long, and an answer six times as long")

    @model_validator(mode="after")
    def _certificate_with_tls(self) -> Self:
        if self.ca_certificate is not None and not self.tls:
            raise KeyProblems([(("tls",), "ca_certificate is of use with `tls: true` only")])
        return self


class ParquetConfig(Section):
    """Parquet files, one per machine, kind of record and day, written when the day is over."""

    folder: str = Field(
        pattern=FOLDER_OR_BUCKET_PATTERN,
        description="where they go: a folder from /, which must be there, or a bucket with a prefix",
        examples=["/srv/plant/history"],
    )


StreamName = Literal["temperatures", "estimates", "writes", "cnc", "displacements", "events", "probes", "references"]


class BrokerConfig(Section):
    """A broker that speaks MQTT 5."""

    host: Host = Field(description="name or address of the broker", examples=["192.168.10.40"])
    port: int | None = Field(
        None, ge=1, le=65535, description="its TCP port; left out, 8883 with TLS and 1883 without", examples=[8883]
    )
    user_name: str | None = Field(None, min_length=1, description="user at the broker", examples=["toolpoint"])
    password_file: Path | None = Field(
        None,
        description="file that holds the password, readable by the service only",
        examples=["/run/credentials/toolpoint-sink.service/mqtt-password"],
    )
    tls: bool = Field(True, description="encrypt, and accept only a broker whose certificate is vouched for")
    ca_certificate: Path | None = Field(
        None,
        description="certificate (PEM) that vouches for the broker's; left out, those of this computer do",
        examples=["/etc/toolpoint/pki/broker-ca.pem"],
    )
    timeout_s: Seconds = Field(10.0, description="connecting may take so long, and an acknowledgement too")
    resend_s: float = Field(
        10.0, ge=0, description="what the broker took less long ago is sent again after the connection was lost [s]"
    )

    @model_validator(mode="after")
    def _password_with_user(self) -> Self:
        if self.password_file is not None and self.user_name is None:
            raise KeyProblems([(("user_name",), "a password needs a user name")])
        if self.ca_certificate is not None and not self.tls:
            raise KeyProblems([(("tls",), "ca_certificate is of use with `tls: true` only")])
        return self

    @property
    def server_port(self) -> int:
        """The broker's port."""
        return self.port or (8883 if self.tls else 1883)


class MqttSinkConfig(BrokerConfig):
    """JSON at an MQTT broker: what is now, for Home Assistant too, and the history row by row."""

    topic: str = Field(
        "toolpoint", pattern=TOPIC_PATTERN, description="first levels of every topic; the machine follows"
    )
    discovery: str | None = Field(
        "homeassistant", pattern=TOPIC_PATTERN, description="first levels of Home Assistant's topics; null: not told"
    )
    history: list[StreamName] = Field(
        list(get_args(StreamName)), description="kinds of record that are sent row by row; []: only what is now"
    )


class SinkConfig(SectionOfDriver):
    """One system to which the history goes, sent by `toolpoint sink run`."""

    name: Name = Field(description="name of the sink in logs, status and its cursor", examples=["plant"])
    driver: Literal["postgresql", "parquet", "mqtt"] = Field(
        description="what it is; the section of that name says where", examples=["postgresql"]
    )
    period_s: Seconds = Field(2.0, description="time from one look for new rows to the next")
    postgresql: PostgresqlConfig | None = Field(
        None, description="a PostgreSQL database", examples=[{"host": "192.168.10.50"}]
    )
    parquet: ParquetConfig | None = Field(
        None,
        description="Parquet files in a folder or an object store",
        examples=[{"folder": "/srv/plant/history"}],
    )
    mqtt: MqttSinkConfig | None = Field(
        None, description="JSON at an MQTT broker", examples=[{"host": "192.168.10.40"}]
    )

    @property
    def exposed(self) -> str:
        """What a connection without TLS cannot keep out."""
        connection = self.postgresql or self.mqtt
        return (
            "" if connection is None or connection.tls else "NOT encrypted: whoever is on its network reads it (`tls`)"
        )

    @property
    def place(self) -> str:
        """Where it is, for people."""
        if self.parquet is not None:
            return self.parquet.folder
        if self.mqtt is not None:
            return f"{self.mqtt.host}:{self.mqtt.server_port}/{self.mqtt.topic}"
        assert self.postgresql is not None
        return f"{self.postgresql.host}:{self.postgresql.port}/{self.postgresql.database}"
