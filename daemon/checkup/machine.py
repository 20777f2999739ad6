"""`toolpoint check`: checks everything that the configuration names."""

import asyncio
import errno
import os
import re
import ssl
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from datetime import UTC, datetime
from ipaddress import ip_address
from pathlib import Path

import numpy as np
from cryptography import x509
from cryptography.hazmat.primitives.serialization import Encoding

from config.records.commissioning import CommissioningError, commissioning_inhibit, load_commissioning
from config.schema import Configuration
from config.schema.cnc_drivers import LATEST_T
from config.schema.service import OpcUaServerConfig, ServiceConfig
from config.schema.sinks import SinkConfig
from config.schema.source_drivers import SourceEntry
from config.schema.temperatures import LineConfig, TemperatureInput
from config.secret_files import SecretError, read_secret
from daemon.checkup.finding import Finding
from daemon.cnc.commissionable import insecure, unchecked, without_text
from daemon.cnc.macro_block import MacroBlock
from daemon.cnc.own_offset import offset_macros
from daemon.model_release.bearings import open_planning
from daemon.model_release.file_access import account_of_daemon
from daemon.model_release.loading import load_released
from daemon.monitor.accounts import read_accounts
from daemon.monitor.listening import in_url, listening
from drivers import registry
from drivers.clock import Clock
from drivers.contract import Capability, DriverError
from models.errors import RefusedInputError

CYCLES_WAITED = 2.5
"""A line must complete a cycle within so many periods."""


OF_THE_HAAS = {
    range(150, 200): "which its probing system writes",
    range(550, 600): "where its probing system keeps what it was calibrated to",
    range(700, 800): "which a program cannot write there",
}
CREDENTIALS = Path("/run/credentials")
"""Here the service manager puts what it hands to the service, and to nobody else."""


def served(configuration: Configuration) -> Iterator[Finding]:
    """Yield whether these files can be used."""
    service, tags = configuration.service, configuration.opcua_server
    if service.http_port is not None and (certificate := service.tls_certificate) and (key := service.tls_key):
        yield _tried("monitor", [certificate], lambda: _monitor(service, certificate, key))
    if (users := service.users) is not None:
        yield _tried("accounts", [users], lambda: f"{len(read_accounts(users))} may log in")
    if tags is not None:
        yield _tried("opcua_server", [tags.certificate, tags.private_key], lambda: _tags(tags))


def sinks(configuration: Configuration) -> Iterator[Finding]:
    """Yield whether files and packages that the sinks need are there; no server is asked."""
    for each in configuration.sinks or ():
        yield _tried(f"sink {each.name}", [], lambda each=each: _sink(each, configuration.machine))  # type: ignore[misc]


def ports(configuration: Configuration) -> Iterator[Finding]:
    """Yield whether the ports that the daemon is to serve are free."""
    service, tags, shdr = configuration.service, configuration.opcua_server, configuration.shdr
    wanted = [("service.http_port", service.http_host, service.http_port)] if service.http_port else []
    wanted += [(f"{name}.port", one.host, one.port) for name, one in (("opcua_server", tags), ("shdr", shdr)) if one]
    for key, host, port in wanted:
        try:
            listening(host, port, 1).close()
        except OSError as error:
            detail = f"{in_url(host, port)} cannot be served ({error.strerror})"
            if error.errno == errno.EADDRINUSE:
                detail = (
                    f"{in_url(host, port)} is taken by another program, or by the daemon, which must be stopped for "
                    f"this check: `sudo ss -ltnp sport = :{port}` names it"
                )
            elif error.errno == errno.EADDRNOTAVAIL:
                detail = f"{host} is no address of this computer: `ip address` lists them"
            yield Finding(subject=key, passed=False, detail=detail)
        else:
            yield Finding(subject=key, passed=True, detail=f"{in_url(host, port)} is free")


def _tried(subject: str, files: list[Path], look: Callable[[], str]) -> Finding:
    """Return what was found; a credential of the service is looked at by the service alone."""
    for path in files:
        if said := _handed_over(path):
            return Finding(subject=subject, passed=True, detail=said)
    try:
        return Finding(subject=subject, passed=True, detail=look())
    except (RefusedInputError, SecretError, OSError, ValueError) as error:
        return Finding(subject=subject, passed=False, detail=str(error))


def _handed_over(path: Path) -> str:
    """Return that a file is a credential, which only the service sees; else ''."""
    hidden = path.is_relative_to(CREDENTIALS) and not path.exists()
    return f"{path} is handed to the service, and not looked at" if hidden else ""


def _sink(sink: SinkConfig, machine: str) -> str:
    """Return what was found of a sink; raises SecretError, or ValueError that says what is missing."""
    from daemon.sinks.contract import SinkError  # noqa: PLC0415 (their libraries are loaded where there is one)
    from daemon.sinks.running import make_messenger, make_sink  # noqa: PLC0415
    from daemon.sinks.vouching import tls_context  # noqa: PLC0415

    found = [f"{sink.place}, not asked", sink.exposed]
    for key, path in sink.secrets.items():
        if said := _handed_over(path):
            found.append(said)
        else:
            read_secret(key, path)
    tls_context(getattr(getattr(sink, sink.driver), "ca_certificate", None))
    if sink.parquet is not None and sink.parquet.folder.startswith("/") and not Path(sink.parquet.folder).is_dir():
        raise ValueError(f"{sink.parquet.folder}: there is no such folder: make it, and let the service write in it")
    try:
        _ = make_sink(sink, machine) if sink.alarms is None else make_messenger(sink)
    except SinkError as error:
        raise ValueError(str(error).removeprefix(f"sink {sink.name}: ")) from error
    return "; ".join(filter(None, found))


def _monitor(service: ServiceConfig, certificate: Path, key: Path) -> str:
    # A web server is loaded only where there is one, and so is OPC UA, a third of the start.
    from daemon.monitor.web.server import Certificate, names_of_certificate  # noqa: PLC0415
    from drivers.opcua.certificates import load_certificate  # noqa: PLC0415

    found = load_certificate(certificate)
    if not (handed := _handed_over(key)):
        try:
            Certificate(certificate, key)
        except ssl.SSLError as error:
            raise ValueError(
                f"{key} is not the private key of {certificate}: give the two that were made together"
            ) from error
        except OSError as error:
            raise ValueError(
                f"{key}: the private key of {certificate} cannot be read ({error.strerror or error})"
            ) from error
    valid = _valid(certificate, found)
    names = names_of_certificate(found.public_bytes(Encoding.PEM))
    if not names:
        raise ValueError(
            f"{certificate} carries no name (subjectAltName), so no browser takes it: make it for the name by which "
            "people reach the monitor"
        )
    if (why := _other_names(service, names)) != "":
        raise ValueError(f"{certificate} is for {', '.join(sorted(names))}, {why}")
    return "; ".join(filter(None, [f"{valid}, for {', '.join(sorted(names))}", handed]))


def _other_names(service: ServiceConfig, names: set[str]) -> str:
    """Return why nobody reaches the monitor by one of these names, '' where somebody may."""
    host = service.http_host.lower()
    if service.http_is_local or service.trusted_proxies:
        return ""  # people come by the name of a proxy or of a tunnel
    try:
        address = ip_address(host)
    except ValueError:
        named = {host, f"*.{host.partition('.')[2]}"} & names
        return "" if named else f"not for service.http_host, {host}: make it for that name"
    if address.is_unspecified or str(address) in names or not all(_is_address(each) for each in names):
        return ""  # its names may lead here
    return f"none of which is service.http_host, {host}: make it for the address or name by which people reach it"


def _is_address(name: str) -> bool:
    try:
        ip_address(name)
    except ValueError:
        return False
    return True


def _tags(section: OpcUaServerConfig) -> str:
    from drivers.opcua.server.settings import Trusted, load_identity  # noqa: PLC0415

    identity, trusted = load_identity(section.certificate, section.private_key), Trusted(section.trusted_clients)
    trusted.find(b"")
    if trusted.problems:
        raise ValueError("; ".join(trusted.problems))
    return _valid(section.certificate, identity.certificate)


def _valid(path: Path, certificate: x509.Certificate) -> str:
    """Return until when a certificate is valid; raises ValueError where that is not now."""
    begins, ends = certificate.not_valid_before_utc, certificate.not_valid_after_utc
    if not begins <= datetime.now(UTC) <= ends:
        raise ValueError(f"{path} is valid from {begins:%Y-%m-%d} to {ends:%Y-%m-%d}: make a new one, or set the clock")
    return f"{path}, valid until {ends:%Y-%m-%d}"


async def preflight(configuration: Configuration, clock: Clock, *, devices: bool) -> AsyncIterator[Finding]:
    """Try everything; nothing is written to the CNC."""
    yield model_finding(configuration)
    yield _record(configuration)
    yield _history(configuration.history.path)
    for finding in served(configuration):
        yield finding
    for finding in sinks(configuration):
        yield finding
    if configuration.spindle_speed is not None:
        yield _spindle_speed(configuration)
    for finding in _tool_number(configuration):
        yield finding
    for finding in _variables_of_a_haas(configuration):
        yield finding
    if not devices:
        return
    for finding in ports(configuration):
        yield finding
    for each in configuration.temperatures.inputs:
        what = "line" if isinstance(each, LineConfig) else "source"
        yield await _attempt(f"{what} {each.name}", lambda each=each: _input(configuration, each, clock))  # type: ignore[misc]
    for entry in () if configuration.displacements is None else configuration.displacements.inputs:
        what = f"source {entry.name}" if isinstance(entry, SourceEntry) else entry.name
        yield await _attempt(what, lambda entry=entry: _displacements(configuration, entry, clock))  # type: ignore[misc]
    yield await _attempt("cnc", lambda: _cnc(configuration, clock))


def model_finding(configuration: Configuration) -> Finding:
    """Return what the daemon's account will find of its model."""
    found = load_released(configuration, account_of_daemon(configuration.history.path))
    if found.model is None:
        pending = _not_released_yet(configuration.compensation.model_file)
        return Finding(subject="thermal model", passed=False, detail=found.inhibit, pending=pending)
    channels = ", ".join(found.model.channels)
    return Finding(subject="thermal model", passed=True, detail=f"{found.in_words()}; channels {channels}")


def _not_released_yet(model_file: Path | None) -> bool:
    """Return whether nobody has ever released a model to this place: a release leaves a link there."""
    return model_file is None or (model_file.parent.is_dir() and not os.path.lexists(model_file))


def _spindle_speed(configuration: Configuration) -> Finding:
    """Return whether spindles, bearings' model and cases of the tuned operations can be read and fit together."""
    section = configuration.spindle_speed
    opened = open_planning(configuration, account_of_daemon(configuration.history.path))
    if opened.inhibit or opened.model is None:
        pending = section is not None and _not_released_yet(section.thermomechanical_model)
        return Finding(subject="spindle speed", passed=False, detail=opened.inhibit, pending=pending)
    detail = f"{opened.model.in_words()}; {len(opened.operations)} operation(s) can be tuned"
    return Finding(subject="spindle speed", passed=True, detail=detail)


def _tool_number(configuration: Configuration) -> Iterator[Finding]:
    """Yield what a program has to do where the control tells which tool was called, not which is in the spindle."""
    if not configuration.cnc.tells_prepared_tool:
        return
    tuning = configuration.spindle_speed
    if tuning is not None and tuning.tool_variable == LATEST_T:
        detail = (
            "#4120 is the latest T word, which may only prepare a tool, and both the call and the daemon read it: no "
            "speed is tuned until the program has named the tool in the spindle by the handshake (cnc.macros.request), "
            "or both read the variable in which the machine's builder keeps it (spindle_speed.tool_variable, "
            "cnc.focas.tool_macro)"
        )
        named = configuration.cnc.macros.request is not None
        yield Finding(subject="tool of the spindle speed", passed=named, detail=detail)
    if any(a.tool_term for a in configuration.compensation.axes.values()):
        detail = (
            "#4120 is the latest T word, which may only prepare a tool: the output holds until the program has named "
            "the one in the spindle by the handshake, or cnc.focas.tool_macro names the variable in which the "
            "machine's builder keeps it"
        )
        yield Finding(subject="tool in the spindle", passed=True, detail=detail)


def _variables_of_a_haas(configuration: Configuration) -> Iterator[Finding]:
    """Yield which macro variables of the configuration are not free on a Haas, and what to name instead."""
    if configuration.cnc.driver != "haas":
        return
    macros, speed, memory = configuration.cnc.macros, configuration.spindle_speed, configuration.guard_memory
    ours = {*macros.block, *macros.allowed, *memory}
    ours |= set() if speed is None else {*speed.macros.model_dump(exclude_none=True).values()}
    found = []
    for taken, of in OF_THE_HAAS.items():
        if here := sorted(ours.intersection(taken)):
            key = "cnc.guard.memory, " if here[0] in memory else ""
            found.append(f"{key}#{here[0]} is one of #{taken[0]} to #{taken[-1]}, {of}")
    free = "#100 to #149, #500 to #549 and #600 to #699 are free"
    yield Finding(subject="variables of the Haas", passed=not found, detail="; ".join([*found, free]))


def _record(configuration: Configuration) -> Finding:
    """Return whether there is a record that fits, or whether `toolpoint commission` could make one."""
    path = configuration.compensation.commissioning_file
    not_made = without_text(configuration)
    refused = "; ".join(filter(None, (insecure(configuration), unchecked(configuration), not_made)))
    if path is None:
        how = "run `toolpoint commission`"
        if refused:
            how = f"`toolpoint commission` makes one, but refuses this configuration so far: {refused}"
        return Finding(
            subject="commissioning",
            passed=False,
            pending=not not_made,
            detail=f"no record (compensation.commissioning_file), so nothing can be switched on: {how}",
        )
    try:
        record = load_commissioning(path, configuration.signatures.public_keys)
    except CommissioningError as error:
        return Finding(subject="commissioning", passed=False, detail=str(error))
    axes = sorted(name for name, axis in configuration.compensation.axes.items() if axis.estimate)
    inhibit = refused or commissioning_inhibit(
        record,
        cnc_identity=record.cnc_identity,
        macros=configuration.cnc.macros,
        axes=axes,
        slopes=configuration.compensation.slopes,
        machine=configuration.machine,
    )
    detail = inhibit or f"{record.cnc_identity} by {record.person} on {record.date}"
    return Finding(subject="commissioning", passed=not inhibit, detail=detail)


def _history(path: Path) -> Finding:
    """Return whether the store can lie where `history.path` says."""
    folder, wrong, pending = path.absolute().parent, "", False
    try:
        there = next(each for each in (folder, *folder.parents) if each.exists())
        if path.is_dir():
            wrong = f"{path} is a folder; name a file in it"
        elif not there.is_dir():
            wrong = f"{there} is no folder, so {path} cannot be made"
        elif pending := there != folder:
            wrong = f"the folder {folder} is not there; the daemon makes it if it may write {there}"
        elif there.stat().st_uid == os.geteuid() and not os.access(there, os.W_OK | os.X_OK):
            wrong = f"nothing can be written in {folder}"
    except PermissionError:  # a service's folder is closed to others, and its own user finds it open
        return Finding(subject="history", passed=True, detail=f"{path}, in a folder that is closed to this user")
    except OSError as error:
        wrong = f"{error.strerror}: {path}"
    detail = f"history.path: {wrong}" if wrong else str(path)
    return Finding(subject="history", passed=not wrong, pending=pending, detail=detail)


async def _attempt(subject: str, work: Callable[[], Awaitable[str]]) -> Finding:
    try:
        return Finding(subject=subject, passed=True, detail=await work())
    except DriverError as error:
        return Finding(subject=subject, passed=False, detail=str(error).removeprefix(f"{subject}: "))
    except TimeoutError:
        return Finding(subject=subject, passed=False, detail="nothing arrived in time")


async def _input(configuration: Configuration, line: TemperatureInput, clock: Clock) -> str:
    source = registry.open_temperature_source(configuration, line, clock)
    try:
        async with asyncio.timeout(CYCLES_WAITED * line.cycle_period_s / clock.speed):
            async for cycle in source.cycles():
                good = int(np.isfinite(cycle.degc).sum())
                if not cycle.complete or not good:
                    raise DriverError(f"{good} of {len(cycle.degc)} sensors answered: {'; '.join(cycle.faults[:3])}")
                exposed = line.connection.exposed if isinstance(line, SourceEntry) else ""
                found = f"{good} sensors, {np.nanmin(cycle.degc):.1f} to {np.nanmax(cycle.degc):.1f} degC"
                return "; ".join(filter(None, (found, exposed, passing_name(line))))
    finally:
        await source.close()
    raise DriverError("it ended")


def passing_name(line: TemperatureInput) -> str:
    """Return what to do about a port's name that goes to another adapter when several are plugged in anew."""
    port = line.port if isinstance(line, LineConfig) else getattr(line.connection, "serial_port", None)
    if port is None or re.fullmatch(r"/dev/tty(USB|ACM)\d+", str(port)) is None:
        return ""
    return (
        f"{port} goes to the adapter that is found first, so it may be another one after a start or a re-plug: "
        "name it by /dev/serial/by-id/... or by-path"
    )


async def _displacements(configuration: Configuration, each: registry.DisplacementInput, clock: Clock) -> str:
    source = registry.open_displacement_source(configuration, each, clock, None)
    period_s = each.cycle_period_s if isinstance(each, SourceEntry) else each.poll_period_s
    exposed = each.connection.exposed if isinstance(each, SourceEntry) else ""
    try:
        async with asyncio.timeout(3 * period_s / clock.speed + 1.0):
            async for sample in source.samples():
                found = f"{sample.source}: {np.array2string(sample.um, precision=1)} um"
                return f"{found}; {exposed}" if exposed else found
    finally:
        await source.close()
    raise DriverError("it ended")


async def _cnc(configuration: Configuration, clock: Clock) -> str:
    cnc = registry.open_cnc(configuration, clock)
    axes, offset = tuple(configuration.compensation.axes), offset_macros(configuration)
    block = MacroBlock(configuration.cnc.macros, axes, {}, also_polled=offset)
    try:
        await cnc.connect()
        sample = await cnc.read(block.polled)
    finally:
        await cnc.close()
    vacant = [n for n in block.polled if sample.macros.get(n) is None and n != configuration.cnc.macros.valid_until]
    if vacant and Capability.READ_MACROS not in cnc.cannot:
        raise DriverError(f"{cnc.identity}: macro variables are vacant: {vacant}; commissioning initialises them")
    if inhibit := _other_control(configuration, cnc.identity, block.echo(sample.macros).guard_version):
        raise DriverError(f"{cnc.identity}: {inhibit}")
    security = "encrypted" if cnc.security == "encrypted" else "NOT secure"
    found = f"{cnc.identity}, {security}, {sample.mode.value}/{sample.run.value}, O{sample.program}"
    recorded = (Capability.READ_MACROS, Capability.SPINDLE_SPEED)
    return "; ".join(
        [found, *(f"no {name.replace('_', ' ')}: {cnc.cannot[name]}" for name in recorded if name in cnc.cannot)]
    )


def _other_control(configuration: Configuration, identity: str, guard_version: float | None) -> str:
    """Return why the record is not that of this control and guard; '' without a record, which is told apart."""
    path = configuration.compensation.commissioning_file
    try:
        record = None if path is None else load_commissioning(path, configuration.signatures.public_keys)
    except CommissioningError:
        return ""
    if record is None:
        return ""
    macros = configuration.cnc.macros
    return commissioning_inhibit(
        record,
        cnc_identity=identity,
        macros=macros,
        axes=(),
        guard_version=guard_version,
        machine=configuration.machine,
    )
