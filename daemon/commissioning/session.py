"""One commissioning as a command: locks, store, signals, and what is written at the end."""

import asyncio
import signal
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path

from config.records.commissioning import CommissioningRecord
from config.schema import Configuration
from daemon.backup.restoring import give_to_owner_of_folder
from daemon.cnc.cnc_lock import CncLock, CncLockError
from daemon.cnc.write_ahead import WriteAheadRecord
from daemon.commissioning.dialogue import Dialogue
from daemon.commissioning.initialising import CommissioningRefusedError
from daemon.commissioning.link import CommissioningLink
from daemon.commissioning.preconditions import refuse_running_daemon
from daemon.commissioning.procedure import Commissioning, Plan
from daemon.commissioning.readings import DisplacementLog, Instruments
from daemon.commissioning.station import Station
from daemon.history.database import HistoryError
from daemon.history.layout import MachineLayout
from daemon.history.writer import HistoryWriter
from drivers import registry
from drivers.clock import Clock
from drivers.contract import Cnc


@dataclass(frozen=True, slots=True, kw_only=True)
class Sources:
    """Where readings come from beside the person."""

    channels: Mapping[str, str] = field(default_factory=dict)
    """Axis -> displacement channel."""
    given: Mapping[tuple[str, str], tuple[float, float, float]] = field(default_factory=dict)
    """(commanded axis, observed axis) -> readings before, at the offset, after [um]."""
    samples: int = 10
    """Samples of a channel per reading."""


async def commission(
    configuration: Configuration,
    plan: Plan,
    sources: Sources,
    dialogue: Dialogue,
    clock: Clock,
    *,
    save: Callable[[CommissioningRecord], None],
    open_cnc: Callable[[], Cnc] | None = None,
) -> CommissioningRecord | None:
    """Commission with the store locked and its audit running; None when only variables were initialised.

    `save` writes the record while no daemon can start: one that did would go on with the record of before.

    SIGINT, SIGTERM and SIGHUP take the offsets back; a second one leaves the machine as it is. Raises
    CommissioningRefusedError, DriverError, or CancelledError after such a signal.
    """
    refuse_running_daemon(configuration.service.socket)
    log = DisplacementLog(configuration, clock) if sources.channels else None
    instruments = Instruments(
        dialogue,
        log=log,
        channels=sources.channels,
        given=sources.given,
        samples=sources.samples,
        patience_s=plan.patience_s,
    )
    history = HistoryWriter(
        configuration.history.path, clock=clock, machine=MachineLayout.from_configuration(configuration)
    )
    try:
        history.start()
    except HistoryError as error:
        raise CommissioningRefusedError(str(error)) from error
    last_block = WriteAheadRecord.beside(configuration.history.path)
    link = CommissioningLink(
        configuration, clock, open_cnc or (lambda: registry.open_cnc(configuration, clock)), history, last_block
    )
    loop, task = asyncio.get_running_loop(), asyncio.current_task()
    assert task is not None
    signals = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    lock = CncLock(configuration.cnc)
    try:
        if open_cnc is None:
            lock.acquire()
        for number in signals:
            loop.add_signal_handler(number, task.cancel)
        station = Station(configuration, link)
        work = Commissioning(configuration, plan, station, dialogue, instruments, history, _today, log)
        if (record := await work.run()) is not None:
            save(record)
        return record
    except CncLockError as error:
        raise CommissioningRefusedError(str(error)) from error
    finally:
        lock.release()
        for number in signals:
            loop.remove_signal_handler(number)
        await asyncio.to_thread(history.close)
        last_block.close()
        await asyncio.to_thread(hand_over, configuration.history.path)


async def commission_by(
    configuration: Configuration,
    plan: Plan,
    sources: Sources,
    dialogue: Dialogue,
    clock: Clock,
    record_file: Path | None,
    save: Callable[[CommissioningRecord], None],
) -> CommissioningRecord | None:
    """Ask who is there and what with, and whether an old record may go; then commission."""
    person = plan.person.strip() or await dialogue.text("Your name (it stands in the record and the audit):")
    if not person:
        raise CommissioningRefusedError("no person is named who answers for the readings; give --person")
    instrument = plan.instrument.strip()
    if not instrument and not plan.initialise_only:
        instrument = await dialogue.text("Instrument (kind and number):")
    if record_file is not None and not plan.initialise_only and await asyncio.to_thread(record_file.exists):
        question = f"{record_file} exists and will be replaced as a whole. Go on?"
        if not await dialogue.confirm(question):
            raise CommissioningRefusedError(f"you said no to: {question}")
    named = replace(plan, person=person, instrument=instrument)
    return await commission(configuration, named, sources, dialogue, clock, save=save)


def hand_over(store: Path) -> None:
    """Give the store's files to the owner of its folder: what root has made the daemon could not write."""
    for path in store.parent.glob(f"{store.name}*"):
        give_to_owner_of_folder(path)


def with_secrets(configuration: Configuration, folder: Path) -> Configuration:
    """Return the configuration with password and key from a folder; raises CommissioningRefusedError."""
    cnc = configuration.cnc
    files = {key: folder / path.name for key, path in cnc.connection.secrets.items()}
    if not files:
        missing = f"{key} is not configured" if (key := cnc.encryption_key) else f"driver {cnc.driver} has no secrets"
        raise CommissioningRefusedError(f"--secrets is given, but {missing}")
    for key, path in files.items():
        if not path.is_file():
            raise CommissioningRefusedError(f"{path} is not there; cnc.{cnc.driver}.{key} names a file like it")
    section = cnc.connection.with_secrets(files)
    return configuration.model_copy(update={"cnc": cnc.model_copy(update={str(cnc.driver): section})})


def check_destination(path: Path) -> None:
    """Refuse, before anything moves, a record's place that cannot be written."""
    if path.is_dir():
        raise CommissioningRefusedError(f"{path} is a folder; name a file")
    if not path.parent.is_dir():
        raise CommissioningRefusedError(f"{path}: there is no folder {path.parent}; make it, or name another file")
    try:
        probe = path.parent / f".{path.name}.probe"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise CommissioningRefusedError(
            f"{path} cannot be written ({error.strerror}); name another file and copy it there afterwards"
        ) from error


def _today() -> str:
    return datetime.now(UTC).astimezone().date().isoformat()
