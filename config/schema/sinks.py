"""Systems of others to which the history and alarms go."""

import re
from pathlib import Path
from typing import Annotated, Literal, get_args

from pydantic import Field

from config.schema.base import (
    FOLDER_OR_BUCKET_PATTERN,
    MAIL_ADDRESS_PATTERN,
    SERVER_PATTERN,
    TOPIC_LEVEL_PATTERN,
    TOPIC_PATTERN,
    WEBHOOK_PATTERN,
    Host,
    Name,
    Problems,
    Seconds,
    Section,
    SectionOfDriver,
    TlsAccount,
    checked,
)


class PostgresqlConfig(TlsAccount):
    """A PostgreSQL database, 13 or newer, with or without TimescaleDB."""

    host: str = Field(pattern=SERVER_PATTERN, description="name or address of the server", examples=["192.168.10.50"])
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


class ParquetConfig(Section):
    """Parquet files, one per machine, kind of record and day, written when the day is over."""

    folder: str = Field(
        pattern=FOLDER_OR_BUCKET_PATTERN,
        description="where they go: a folder from /, which must be there, or a bucket with a prefix",
        examples=["/srv/plant/history"],
    )


StreamName = Literal["temperatures", "estimates", "writes", "cnc", "displacements", "events", "probes", "references"]


class BrokerConfig(TlsAccount):
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


TopicLevel = Annotated[str, Field(pattern=TOPIC_LEVEL_PATTERN, max_length=80)]


class SparkplugConfig(BrokerConfig):
    """An edge node of Sparkplug B 3.0, called like the machine, with the machine as its device."""

    group: TopicLevel = Field("Toolpoint", description="group ID of the edge node")
    device: TopicLevel = Field("Machine", description="device ID of the machine")
    primary_host: TopicLevel | None = Field(
        None,
        description="ID of the host without which nothing is sent; none: hosts need not be there",
        examples=["scada"],
    )


AlarmKind = Literal[
    "fault", "daemon", "hold", "output", "link", "sensor", "model", "store", "job", "disk", "certificate"
]
MailAddress = Annotated[str, Field(pattern=MAIL_ADDRESS_PATTERN, max_length=254)]


class AlarmsConfig(Section):
    """What people are told, and how often."""

    kinds: list[AlarmKind] | None = Field(
        None, min_length=1, description="only these; none: all", examples=[["fault", "daemon", "hold", "sensor"]]
    )
    hold_longer_than_s: Seconds = Field(300.0, description="the output has been in HOLD for longer")
    sensor_longer_than_s: Seconds = Field(600.0, description="a sensor has been missing or left out for longer")
    link_longer_than_s: Seconds = Field(180.0, description="a link has been down for longer")
    daemon_longer_than_s: Seconds = Field(120.0, description="the daemon has not answered for longer")
    disk_free_percent: float = Field(10.0, gt=0, lt=100, description="less than this is free on the store's disk [%]")
    certificate_days: float = Field(30.0, gt=0, description="a certificate ends within so many days [d]")
    interval_s: Seconds = Field(
        300.0,
        description="least time between two messages, what comes meanwhile goes together; FAULT and a daemon that does "
        "not run wait for each other only",
    )
    remind_after_h: float = Field(24.0, gt=0, description="what is still so is told again after this time [h]")


class WebhookConfig(Section):
    """A web server that takes alarms as JSON by POST."""

    url: str | None = Field(
        None,
        pattern=WEBHOOK_PATTERN,
        description="address; http:// sends in the clear",
        examples=["https://chat.plant.example/hooks/42"],
    )
    url_file: Path | None = Field(
        None,
        description="file that holds the address instead of `url`, where whoever knows the address may post",
        examples=["/run/credentials/toolpoint-sink.service/webhook-url"],
    )
    token_file: Path | None = Field(
        None,
        description="file with the token that is sent as `Authorization: Bearer`",
        examples=["/run/credentials/toolpoint-sink.service/webhook-token"],
    )
    ca_certificate: Path | None = Field(
        None,
        description="certificate (PEM) that vouches for the server's; left out, those of this computer do",
        examples=["/etc/toolpoint/pki/plant-ca.pem"],
    )
    timeout_s: Seconds = Field(10.0, description="a message must be taken within this time")
    alarms: AlarmsConfig = Field(default_factory=AlarmsConfig, description="what is told, and how often")

    @checked
    def _one_address(self) -> Problems:
        if (self.url is None) == (self.url_file is None):
            yield ("url",), "give either url or url_file"
        elif self.token_file is not None and (self.url or "").startswith("http:"):
            yield ("token_file",), "would go over the network in the clear: give an https:// address"


class MailConfig(Section):
    """A mail server that takes alarms over SMTP."""

    host: Host = Field(description="name or address of the server", examples=["mail.plant.example"])
    port: int = Field(587, ge=1, le=65535, description="its TCP port; 465 is usual with `encryption: tls`")
    encryption: Literal["starttls", "tls", "none"] = Field(
        "starttls", description="how the connection is encrypted; none: in the clear, within one network only"
    )
    ca_certificate: Path | None = Field(
        None,
        description="certificate (PEM) that vouches for the server's; left out, those of this computer do",
        examples=["/etc/toolpoint/pki/plant-ca.pem"],
    )
    user_name: str | None = Field(None, min_length=1, description="account at the server", examples=["toolpoint"])
    password_file: Path | None = Field(
        None,
        description="file that holds its password, readable by the service only",
        examples=["/run/credentials/toolpoint-sink.service/mail-password"],
    )
    sender: MailAddress = Field(description="address it comes from", examples=["toolpoint@plant.example"])
    recipients: list[MailAddress] = Field(
        min_length=1, max_length=50, description="whom it goes to", examples=[["maintenance@plant.example"]]
    )
    timeout_s: Seconds = Field(10.0, description="a message must be taken within six times this")
    alarms: AlarmsConfig = Field(default_factory=AlarmsConfig, description="what is told, and how often")

    @checked
    def _account_over_tls(self) -> Problems:
        if (self.user_name is None) != (self.password_file is None):
            missing = "user_name" if self.user_name is None else "password_file"
            yield (missing,), "give user_name and password_file together"
        elif self.encryption == "none" and (self.password_file or self.ca_certificate):
            yield ("encryption",), "password and ca_certificate are of use with starttls or tls only"


class SinkConfig(SectionOfDriver):
    """One system to which the history or alarms go, sent by `toolpoint sink run`."""

    name: Name = Field(description="name of the sink in logs, status and its cursor", examples=["plant"])
    driver: Literal["postgresql", "parquet", "mqtt", "sparkplug", "webhook", "mail"] = Field(
        description="what it is; the section of that name says where", examples=["postgresql"]
    )
    period_s: Seconds = Field(
        0.5, description="time from one look for new rows to the next; the store is read when something was committed"
    )
    postgresql: PostgresqlConfig | None = Field(
        None, description="a PostgreSQL database", examples=[{"host": "192.168.10.50"}]
    )
    parquet: ParquetConfig | None = Field(
        None, description="Parquet files in a folder or an object store", examples=[{"folder": "/srv/plant/history"}]
    )
    mqtt: MqttSinkConfig | None = Field(
        None, description="JSON at an MQTT broker", examples=[{"host": "192.168.10.40"}]
    )
    sparkplug: SparkplugConfig | None = Field(
        None, description="an edge node of Sparkplug B", examples=[{"host": "192.168.10.40"}]
    )

    webhook: WebhookConfig | None = Field(
        None, description="alarms to a web server", examples=[{"url": "https://chat.plant.example/hooks/42"}]
    )
    mail: MailConfig | None = Field(
        None,
        description="alarms by mail",
        examples=[
            {
                "host": "mail.plant.example",
                "sender": "toolpoint@plant.example",
                "recipients": ["maintenance@plant.example"],
            }
        ],
    )

    @property
    def alarms(self) -> AlarmsConfig | None:
        """What it tells people; None: it takes the history."""
        section = self.webhook or self.mail
        return section.alarms if section is not None else None

    @property
    def exposed(self) -> str:
        """What a connection without TLS cannot keep out."""
        connection = self.postgresql or self.mqtt or self.sparkplug
        clear = connection is not None and not connection.tls
        clear |= self.mail is not None and self.mail.encryption == "none"
        clear |= self.webhook is not None and (self.webhook.url or "").startswith("http:")
        return "NOT encrypted: whoever is on its network reads it" if clear else ""

    @property
    def secrets(self) -> dict[str, Path]:
        """Key of its section -> file that holds a secret."""
        section = getattr(self, self.driver)
        found = {key: getattr(section, key, None) for key in ("password_file", "token_file", "url_file")}
        return {key: path for key, path in found.items() if path is not None}

    @property
    def place(self) -> str:
        if self.parquet is not None:
            return re.sub("key=[^&]*", "key=...", re.sub("//.*@", "//...@", self.parquet.folder))  # it may hold keys
        if self.mqtt is not None:
            return f"{self.mqtt.host}:{self.mqtt.server_port}/{self.mqtt.topic}"
        if self.sparkplug is not None:
            return f"{self.sparkplug.host}:{self.sparkplug.server_port}/spBv1.0/{self.sparkplug.group}"
        if self.webhook is not None:  # without its path, which may be a secret
            address = re.match(r"https?://[^/?]+", self.webhook.url or "")
            return address.group() if address else str(self.webhook.url_file)
        if self.mail is not None:
            return f"{self.mail.host}:{self.mail.port}"
        assert self.postgresql is not None
        return f"{self.postgresql.host}:{self.postgresql.port}/{self.postgresql.database}"
