"""What Home Assistant is told of a machine, so that its values appear there by themselves (MQTT discovery)."""

import json
import re
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

LONGEST_STATE = 250
"""Home Assistant takes no longer text as a state."""
UM = {"unit_of_measurement": "µm", "state_class": "measurement", "suggested_display_precision": 1}
DEGC = {"device_class": "temperature", "unit_of_measurement": "°C", "state_class": "measurement"}
RPM = {"unit_of_measurement": "rpm", "state_class": "measurement"}
PROBLEM = {"device_class": "problem", "payload_on": "ON", "payload_off": "OFF"}
BY_NAME: Mapping[str, tuple[str, str, Mapping[str, Any]]] = {
    "compensation_um": ("compensation", "Compensation", UM),
    "applied_um": ("applied", "Applied compensation", UM),
    "error_without_um": ("error_without", "Thermal error without compensation", UM),
    "error_with_um": ("error_with", "Thermal error with compensation", UM),
    "displacement_um": ("displacement", "Displacement", UM),
    "label_degc": ("temperature", "Temperature", DEGC),
}
"""Field of the current values -> object, words and unit of its numbers."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Entity:
    """One value in Home Assistant."""

    component: str
    object_id: str
    name: str
    template: str
    more: Mapping[str, Any] = field(default_factory=dict)


def plain_id(text: str) -> str:
    """Return letters, digits and underscores that stand for a text and, but for case, for no other."""
    plain = re.sub(r"[^a-z0-9]+", "_", text.lower()).strip("_")
    return plain if plain == text.lower() else f"{plain}_{zlib.crc32(text.encode()):08x}"


def entities(values: Mapping[str, Any]) -> Iterator[Entity]:
    """Yield what the current values hold."""
    text = f"{{{{ (value_json.%s or '')[:{LONGEST_STATE}] }}}}"
    yield Entity(component="sensor", object_id="state", name="State", template="{{ value_json.state }}")
    yield Entity(component="sensor", object_id="reason", name="Reason", template=text % "reason")
    yield Entity(component="sensor", object_id="alarm_text", name="Alarm text", template=text % "alarm")
    alarm = "{{ 'ON' if value_json.%s else 'OFF' }}"
    for name, words in (("alarm", "Alarm"), ("cnc_alarm", "CNC alarm")):
        yield Entity(component="binary_sensor", object_id=name, name=words, template=alarm % name, more=PROBLEM)
    for name, (object_id, words, unit) in BY_NAME.items():
        for key in values[name]:
            template = f"{{{{ value_json.{name}[{json.dumps(key, ensure_ascii=False)}] }}}}"
            yield Entity(
                component="sensor",
                object_id=f"{object_id}_{plain_id(key)}",
                name=f"{words} {key}",
                template=template,
                more=unit,
            )
    speed = "{{ value_json.spindle_speed_rpm }}"
    yield Entity(component="sensor", object_id="spindle_speed", name="Spindle speed", template=speed, more=RPM)


def discovery(
    prefix: str, machine: str, base: str, values: Mapping[str, Any], version: str
) -> Iterator[tuple[str, bytes]]:
    """Yield topic and payload of every entity of a machine whose topics begin with `base`."""
    node = plain_id(machine)
    for entity in entities(values):
        content = {
            "name": entity.name,
            "unique_id": f"toolpoint_{node}_{entity.object_id}",
            "state_topic": f"{base}/state",
            "value_template": entity.template,
            "availability_topic": f"{base}/status",
            **entity.more,
            "device": {
                "identifiers": [f"toolpoint_{node}"],
                "name": machine,
                "manufacturer": "Toolpoint",
                "model": "thermal compensation",
                "sw_version": version,
            },
            "origin": {"name": "Toolpoint", "sw_version": version},
        }
        topic = f"{prefix}/{entity.component}/toolpoint_{node}/{entity.object_id}/config"
        yield topic, json.dumps(content, ensure_ascii=False).encode()
