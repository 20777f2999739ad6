"""Systems of others to which the history goes."""

from pathlib import Path
from typing import Literal, Self

from pydantic import Field, model_validator

from config.schema.base import FOLDER_OR_BUCKET_PATTERN, KeyProblems, Name, Seconds, Section
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


class SinkConfig(SectionOfDriver):
    """One system to which the history goes, sent by `toolpoint sink run`."""

    name: Name = Field(description="name of the sink in logs, status and its cursor", examples=["plant"])
    driver: Literal["postgresql", "parquet"] = Field(
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

    @property
    def place(self) -> str:
        """Where it is, for people."""
        if self.parquet is not None:
            return self.parquet.folder
        assert self.postgresql is not None
        return f"{self.postgresql.host}:{self.postgresql.port}/{self.postgresql.database}"
