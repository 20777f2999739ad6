"""What is wrong at a machine now, as its daemon, its disk and its certificates say."""

import contextlib
import shutil
from collections.abc import Iterable, Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import structlog
from cryptography import x509
from pydantic import BaseModel

from config.files import read_whole
from config.schema import Configuration
from config.schema.sinks import AlarmsConfig
from daemon.history.reader import HistoryReader
from daemon.model_release.model_errors import drift_document, in_force, measured_errors
from daemon.model_release.past_recordings import commissioned_um_per_unit
from daemon.monitor.control_client import ControlClient, DaemonUnreachableError
from daemon.monitor.control_socket import RequestError
from daemon.sinks.alarms.ledger import Condition, Key
from models.records import OutputState

log = structlog.get_logger(__name__)
ANSWER_S = 5.0
SHOWN_SENSORS = 20
"""With more sensors that are not good there is one alarm for all of them."""
FREED_PERCENT = 2.0
"""A disk must have so much more before it counts as free again [%]."""
DAY_S = 86_400.0
WEARING_DAYS = 400.0
"""Probe values of so many days say whether a model wears out."""
PEM = b"-----BEGIN CERTIFICATE-----"
HARM = "left by the estimate where"
"""Part of the reason for which a model that does harm is not followed."""
HELD = "held for longer than"
"""The output's own alarm of HOLD begins so."""


def asked(socket: Path) -> dict[str, Any] | str:
    """Return the daemon's status, or why it does not say it."""
    try:
        client = ControlClient(socket, ANSWER_S)
        try:
            return client.ask("status")
        finally:
            client.close()
    except (DaemonUnreachableError, RequestError, OSError, ValueError, LookupError) as error:
        return str(error)


class Lasting:
    """Since when each thing has been wrong that counts after a time only."""

    def __init__(self, since_utc_s: Mapping[Key, float], now_utc_s: float) -> None:
        self._before, self._now_utc_s = since_utc_s, now_utc_s
        self.since_utc_s: dict[Key, float] = {}

    def condition(self, kind: str, subject: str, text: str, longer_than_s: float) -> Iterator[Condition]:
        """Yield what has been wrong for long enough."""
        since_utc_s = min(self._before.get((kind, subject), self._now_utc_s), self._now_utc_s)
        self.since_utc_s[kind, subject] = since_utc_s
        if self._now_utc_s - since_utc_s >= longer_than_s:
            yield Condition(kind=kind, subject=subject, text=text, since_utc_s=since_utc_s)

    def one_of_many(self, key: Key) -> bool:
        """Say whether this is a single sensor while there are so many that none is looked at alone."""
        return key[0] == "sensor" and key[1] != "" and ("sensor", "") in self.since_utc_s

    def keep(self, kinds: Iterable[str]) -> None:
        """Let what nobody could judge be as it was."""
        self.since_utc_s |= {key: since for key, since in self._before.items() if key[0] in kinds}


OF_STATUS = ("output", "link", "sensor", "model", "store", "job")
"""Kinds that the daemon's status tells."""


def of_status(
    status: Mapping[str, Any], configuration: Configuration, alarms: AlarmsConfig, own_link: str, lasting: Lasting
) -> Iterator[Condition]:
    """Yield what the daemon says is wrong; `own_link` is how it calls the sink that tells."""
    output, speed = status["output"], status["spindle_speed"] or {}
    if output["alarm"] and output["state"] != OutputState.FAULT and not output["alarm"].startswith(HELD):
        yield from lasting.condition("output", "", output["alarm"], 0.0)
    if speed.get("alarm"):
        yield from lasting.condition("output", "spindle speed", speed["alarm"], 0.0)
    if HARM in output["reason"]:
        yield from lasting.condition("model", "stopped helping", output["reason"], 0.0)
    if problem := status["model"].get("problem"):
        yield from lasting.condition("model", "refused", problem, 0.0)
    if problem := status["history"]["problem"]:
        yield from lasting.condition("store", "", problem, 0.0)
    for job in status.get("jobs", ()):
        if job["problem"]:
            yield from lasting.condition("job", job["name"], job["problem"], 0.0)
    for link in status["links"]:
        if not link["up"] and link["name"] != own_link:
            yield from lasting.condition("link", link["name"], link["problem"], alarms.link_longer_than_s)
    for subject, text in _sensors(status, configuration):
        if not subject:
            lasting.keep(("sensor",))
        yield from lasting.condition("sensor", subject, text, alarms.sensor_longer_than_s)


def _sensors(status: Mapping[str, Any], configuration: Configuration) -> Iterator[tuple[str, str]]:
    """Yield name and what is wrong of each sensor that does not count, or one entry for many."""
    temperatures, estimate = status["temperatures"] or {}, status["estimate"] or {}
    wrong = {int(number): reason for number, reason in temperatures.get("not_good", {}).items()}
    for number in estimate.get("imputed", ()):
        wrong.setdefault(int(number), "the model leaves it out: it departs from what the other sensors say")
    count = max(len(wrong), temperatures.get("not_good_count", 0))
    if count > SHOWN_SENSORS:
        yield "", f"{count} sensors do not count, such as {', '.join(str(number) for number in sorted(wrong)[:5])}"
        return
    known = {sensor.id: sensor for sensor in configuration.temperatures.every_sensor}
    for number, reason in sorted(wrong.items()):
        sensor = known.get(number)
        place = "" if sensor is None else f" ({', '.join(filter(None, (sensor.label, sensor.component)))})"
        yield f"{number}{place}", reason


def of_computer(
    configuration: Configuration, alarms: AlarmsConfig, active: Iterable[Key], now_utc_s: float
) -> Iterator[Condition]:
    """Yield disks that are nearly full, and certificates that end soon; `active`: alarms that there are already."""
    folders = [configuration.history.path.parent]
    if configuration.history.backup is not None:
        folders.append(configuration.history.backup.directory)
    seen: set[int] = set()
    for folder in folders:
        try:
            device, usage = folder.stat().st_dev, shutil.disk_usage(folder)
        except OSError:
            continue  # the daemon says what is wrong with its folders
        free = 100.0 * usage.free / max(usage.total, 1)
        limit = alarms.disk_free_percent + (FREED_PERCENT if ("disk", str(folder)) in active else 0.0)
        if device not in seen and free < limit:
            text = f"{free:.1f} % of the disk is free ({usage.free / 2**30:.1f} GiB): free space on it"
            yield Condition(kind="disk", subject=str(folder), text=text, since_utc_s=now_utc_s)
        seen.add(device)
    for key, path in certificates(configuration):
        if (ends_utc_s := _ends_utc_s(key, path)) is None:
            continue
        left_d = (ends_utc_s - now_utc_s) / DAY_S
        if left_d < alarms.certificate_days:
            ends = f"{datetime.fromtimestamp(ends_utc_s, UTC):%Y-%m-%d}"
            text = f"{path} ends on {ends}" if left_d > 0.0 else f"{path} ended on {ends}"
            yield Condition(kind="certificate", subject=key, text=f"{text}: renew it", since_utc_s=now_utc_s)


def worn_models(configuration: Configuration, now_utc_s: float) -> Iterator[Condition]:
    """Yield axes whose model in force should be trained anew, as `toolpoint model drift` says; raises HistoryError."""
    units = commissioned_um_per_unit(configuration)
    with HistoryReader(configuration.history.path) as reader:
        past_s = now_utc_s - WEARING_DAYS * DAY_S
        errors = measured_errors(configuration, reader, units, from_utc_s=past_s, to_utc_s=now_utc_s)
    least_um = configuration.compensation.output.harm_above_um
    judged = drift_document(errors, bound=None, least_error_um=least_um)
    worn = {each["axis"]: each for each in in_force(judged) if each["retrain"]}
    for axis, found in worn.items():
        share, first = (100.0 * found["drift"][key] for key in ("share", "first_share"))
        text = f"it leaves {share:.0f} % of the error, at first {first:.0f} %: plan to train it anew"
        yield Condition(kind="model", subject=f"wears out, axis {axis}", text=text, since_utc_s=now_utc_s)


def certificates(section: BaseModel, at: str = "") -> Iterator[tuple[str, Path]]:
    """Yield key and file of every certificate that a configuration names, or that lies in the folder it names."""
    for name in type(section).model_fields:
        value, key = getattr(section, name), f"{at}{name}"
        if isinstance(value, BaseModel):
            yield from certificates(value, f"{key}.")
        elif isinstance(value, list):
            for index, each in enumerate(value):
                if isinstance(each, BaseModel):
                    yield from certificates(each, f"{key}[{index}].")
        elif isinstance(value, Path) and name.endswith("certificate"):
            yield key, value
        elif isinstance(value, Path) and name == "trusted_clients":
            with contextlib.suppress(OSError):  # the daemon says what is wrong with its folders
                yield from [(f"{key} {each.name}", each) for each in sorted(value.iterdir())]


def _ends_utc_s(key: str, path: Path) -> float | None:
    """Return when a certificate ends; of several authorities the last, of a chain the first. None: not known."""
    try:
        content = read_whole(path)
        if PEM in content:
            found = x509.load_pem_x509_certificates(content)
        else:
            found = [x509.load_der_x509_certificate(content)]
    except (OSError, ValueError) as error:
        log.info("alarms.certificate_unread", key=key, path=str(path), problem=str(error))
        return None
    ends = [each.not_valid_after_utc.timestamp() for each in found]
    return max(ends) if key.endswith("ca_certificate") else min(ends)
