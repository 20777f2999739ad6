"""The plant's end of a broker: what takes the rows that machines publish and stores them."""

from pydantic import Field

from config.schema.base import TOPIC_PATTERN, Section
from config.schema.sinks import BrokerConfig, PostgresqlConfig


class SubscriptionConfig(BrokerConfig):
    """What is taken from a broker."""

    topic: str = Field("toolpoint", pattern=TOPIC_PATTERN, description="first levels of every topic of the machines")
    client_id: str = Field(
        "toolpoint-store",
        min_length=1,
        description="name of the session that the broker keeps; one process may have it",
    )


class PlantStoreConfig(Section):
    """A broker and the database into which its rows go."""

    mqtt: SubscriptionConfig = Field(description="the broker", examples=[{"host": "192.168.10.40"}])
    postgresql: PostgresqlConfig = Field(description="the database", examples=[{"host": "192.168.10.50"}])
