"""`toolpoint backup` and `toolpoint restore`."""

import contextlib
import signal
import sys
import threading
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import click

from daemon.cli.common import FAILED, FILE, config_option, option, read_configuration, refuse, say, write_json
from daemon.cli.options import EXISTING_FILE, json_option
from models.json_values import printable

BREAKING_OFF = (signal.SIGHUP, signal.SIGTERM)


@contextlib.contextmanager
def undone_when_broken_off() -> Iterator[None]:
    """Let a terminal that goes, or the end of the service, end a command as Ctrl-C does: half of it is undone."""

    def end(*_: object) -> None:
        for number in BREAKING_OFF:
            signal.signal(number, signal.SIG_IGN)
        sys.exit(FAILED)

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in BREAKING_OFF}
    try:
        for number in BREAKING_OFF:
            if before[number] is signal.SIG_DFL:  # `nohup` has it ignored
                signal.signal(number, end)
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@click.command()
@click.argument("destination", required=False, type=FILE)
@option(
    "--keep",
    type=click.IntRange(min=1),
    help="DESTINATION is a folder; afterwards remove all but its newest N back-ups.",
)
@config_option
@json_option
def backup(destination: Path | None, keep: int | None, config_path: Path, json_path: str | None) -> None:
    """Write history, configuration, models, commissioning record and last block into one tar.

    DESTINATION is a new file whose name ends in .tar, or a folder, in which the back-up gets a name of its own; without
    it, history.backup.directory. The daemon may run. Passwords and keys are not in it.
    """
    from daemon.backup.making import make_backup, make_folder, remove_old
    from daemon.backup.manifest import BackupError
    from daemon.backup.names import backup_name

    configuration = read_configuration(config_path)
    folder_wanted = destination is None or keep is not None
    if destination is None:
        if configuration.history.backup is None:
            refuse("name a DESTINATION, or set history.backup.directory in the configuration")
        destination = configuration.history.backup.directory
    try:
        if folder_wanted:
            make_folder(destination)
    except BackupError as error:
        refuse(str(error), FAILED)
    into_folder = destination.is_dir()
    if not into_folder and destination.suffix != ".tar":
        refuse(f"{destination}: there is no such folder; mount it or make it, or name a file that ends in .tar", FAILED)
    name = backup_name(configuration.machine, datetime.now(UTC))
    path = destination / name if into_folder else destination
    try:
        with undone_when_broken_off():
            manifest = make_backup(configuration, config_path, path)
        removed = remove_old(destination, configuration.machine, keep, spare=path) if keep is not None else []
    except BackupError as error:
        refuse(str(error), FAILED)
    size_mib = path.stat().st_size / 2**20
    say(f"{path}: {len(manifest.files)} files, {size_mib:.1f} MiB; removed {len(removed)} older")
    write_json(
        json_path,
        {
            "path": str(path),
            "size_mib": size_mib,
            "removed": [str(old) for old in removed],
            "manifest": manifest.model_dump(mode="json"),
        },
    )


@click.command()
@click.argument("archive", type=EXISTING_FILE)
@option("--verify", "verify_only", is_flag=True, help="Prove every file of the back-up and do nothing else.")
@option("--replace", is_flag=True, help="Move what is there already aside, under another name.")
@option("--keep-configuration", is_flag=True, help="Leave the installed configuration in force.")
@option("--accept-unsigned", is_flag=True, help="Restore although no accepted key has signed it.")
@option("--store", type=FILE, help="Where the history goes.")
@option("--commissioning-file", type=FILE, help="Where the commissioning record goes.")
@option("--model-file", type=FILE, help="Where the model goes, its releases beside it.")
@option("--bearings-file", type=FILE, help="Where the bearing model goes, its releases beside it.")
@config_option
@json_option
def restore(
    archive: Path,
    verify_only: bool,
    replace: bool,
    keep_configuration: bool,
    accept_unsigned: bool,
    config_path: Path,
    json_path: str | None,
    **places: Path | None,
) -> None:
    """Restore ARCHIVE while the daemon is stopped; nothing is overwritten or deleted.

    Everything goes to where the configuration says that is installed at --config, or an option; where the archive's
    own configuration means other places, nothing is restored. All of the archive is proved before anything is
    written. The daemon then starts in FAULT and moves nothing until a person acknowledges.
    """
    from daemon.backup import restoring
    from daemon.backup.manifest import BackupError
    from daemon.backup.places import Places
    from daemon.model_release.releasing import person_now

    try:
        if verify_only:
            manifest = restoring.read_manifest(archive)
            say(f"{archive}: whole; {manifest.machine}, {manifest.created}, {len(manifest.files)} files")
            write_json(json_path, manifest.model_dump(mode="json"))
            return
        with undone_when_broken_off():
            done = restoring.restore(
                archive,
                config_path,
                person=person_now(),
                replace=replace,
                given=Places(**{name: path and path.absolute() for name, path in places.items()}),
                keep_configuration=keep_configuration,
                accept_unsigned=accept_unsigned,
            )
    except BackupError as error:
        refuse(str(error), FAILED)
    for path in done.placed:
        say(f"restored {path}")
    for path in done.kept:
        say(f"kept     {path}")
    for path in done.left:
        say(f"left     {path}: the machine was commissioned since the back-up; move it away to restore that of then")
    not_here = [*done.manifest.left_out, *done.unplaced]
    for each in not_here:
        say(f"not here {printable(each)}")
    say("put passwords and keys back, start the daemon, compare the macros, then `toolpoint acknowledge`")
    paths = {name: [str(path) for path in getattr(done, name)] for name in ("placed", "kept", "left")}
    write_json(json_path, paths | {"not_here": not_here})
