"""Configuration, store, models and record of one machine in a folder, as an installation has them."""

import json
import time
from pathlib import Path

import numpy as np
import yaml
from control_rig import SENSOR_IDS, machine, record_for
from small_model import model

from config.loader import load_configuration
from daemon.backup.making import make_backup
from daemon.cnc.write_ahead import WriteAheadRecord
from daemon.history.layout import MachineLayout
from daemon.history.writer import HistoryWriter
from daemon.model_release.releasing import release
from daemon.state_store.documents import DaemonAlive, WantedAxes
from daemon.state_store.store import StateStore
from drivers.clock import SystemClock
from models.control.reference_records import ReferenceDocument, ReferenceRecord, ReferenceState
from models.records import Reference

REFERENCE = Reference(
    reference_id="r",
    time=SystemClock().now(),
    source="O1000 N100",
    degc=np.full(len(SENSOR_IDS), 20.0),
    program=1000,
    work_offset=54,
    power_on_count=7,
)


class Installation:
    """Configuration, store, models and record of one machine in a folder, as files name them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.config_path = folder / "etc/toolpoint.yaml"
        for name in ("etc", "state", "models"):
            (folder / name).mkdir(parents=True)
        rig = machine(folder / "state")
        content = json.loads(rig.model_dump_json(exclude_defaults=True))
        content["machine"] = "Mill 7 (hall)"
        content["history"] = {"path": "../state/history.sqlite"}
        content["compensation"] |= {
            "model_file": "../models/model.json",
            "commissioning_file": "commissioning.json",
            "allow_writable_model_directory": True,
        }
        self.config_path.write_text("# written by hand\n" + yaml.safe_dump(content), encoding="utf-8")
        self.configuration = load_configuration(self.config_path)
        (folder / "etc/commissioning.json").write_text(record_for(rig).model_dump_json(), encoding="utf-8")

    def writer(self) -> HistoryWriter:
        return HistoryWriter(
            self.configuration.history.path,
            clock=SystemClock(),
            machine=MachineLayout.from_configuration(self.configuration),
        )

    def fill(self) -> None:
        """Leave what a daemon that was killed at work leaves."""
        writer = self.writer()
        writer.start()
        store = StateStore(writer, SystemClock())
        store.put(WantedAxes(axes={"y": True, "z": True}))
        record = ReferenceRecord(reference=REFERENCE)
        store.put(ReferenceDocument(state=ReferenceState.VALID, record=record))
        store.put(DaemonAlive(utc_s=time.time()))
        writer.event("note", "before the back-up", "anna")
        writer.close()
        kept = WriteAheadRecord.beside(self.configuration.history.path)
        kept.keep({500: (7.0,), 503: (0.01,)})
        kept.close()

    def release(self, *names: str) -> None:
        for name in names:
            path = self.folder / f"{name}.json"
            path.write_text(model(name).to_json(), encoding="utf-8")
            release(self.configuration, path, person="anna")

    def backup(self, name: str = "backup.tar") -> Path:
        path = self.folder / name
        make_backup(self.configuration, self.config_path, path)
        return path
