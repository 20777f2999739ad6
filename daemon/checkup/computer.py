"""`toolpoint doctor`: checks this computer."""

import os
import re
import sqlite3
import sys
import time
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, distribution, packages_distributions, version
from pathlib import Path

from config.loader import ConfigurationError, load_configuration
from daemon.checkup.finding import Finding
from daemon.checkup.machine import model_finding

OUR_PACKAGES = ("models", "drivers", "config", "daemon")
SAFE_SQLITE = (3, 51, 3)
"""From here on SQLite's WAL is safe with several writers; the daemon has one writer, so older ones serve too."""


def examine(config_path: Path | None = None) -> Iterator[Finding]:
    """Yield one finding per subject; those of a machine only where its configuration is given."""
    yield Finding(
        subject="python", passed=sys.version_info >= (3, 11), detail=f"{sys.version.split()[0]} at {sys.executable}"
    )
    yield _requirements()
    yield _clashes()
    yield _environment()
    yield Finding(
        subject="sqlite",
        passed=True,
        detail=sqlite3.sqlite_version
        + (
            ""
            if sqlite3.sqlite_version_info >= SAFE_SQLITE
            else " (older than 3.51.3: keep to one writer, as the daemon does)"
        ),
    )
    yield _serial_ports()
    yield _clock()
    if config_path is not None:
        yield _model(config_path)


def _requirements() -> Finding:
    problems, seen = [], 0
    for requirement in distribution("toolpoint").requires or []:
        if "extra ==" in requirement:
            continue
        match = re.match(r"[A-Za-z0-9._-]+", requirement)
        assert match is not None
        seen += 1
        try:
            version(match.group())
        except PackageNotFoundError:
            problems.append(f"{match.group()} is not installed")
    return Finding(
        subject="packages", passed=not problems, detail="; ".join(problems) or f"{seen} requirements are installed"
    )


def _clashes() -> Finding:
    """The four package names are common words: another distribution must not own one of them."""
    owners = packages_distributions()
    clashes = [
        f"{name} also belongs to {', '.join(others)}"
        for name in OUR_PACKAGES
        if (others := sorted(set(owners.get(name, [])) - {"toolpoint"}))
    ]
    return Finding(
        subject="package names",
        passed=not clashes,
        detail="; ".join(clashes) + "; install Toolpoint into an environment of its own"
        if clashes
        else "models, drivers, config and daemon belong to Toolpoint alone",
    )


def _environment() -> Finding:
    own = sys.prefix != sys.base_prefix
    return Finding(
        subject="environment",
        passed=own,
        detail=sys.prefix if own else "not a virtual environment; install Toolpoint into one of its own",
    )


def _serial_ports() -> Finding:
    ports = sorted(
        str(path)
        for folder in (Path("/dev/serial/by-id"), Path("/dev/serial/by-path"))
        if folder.is_dir()
        for path in folder.iterdir()
    )
    if not ports:
        return Finding(subject="serial ports", passed=True, detail="none is plugged in")
    closed = [port for port in ports if not os.access(port, os.R_OK | os.W_OK)]
    detail = f"no permission for {', '.join(closed)}; join the group dialout" if closed else ", ".join(ports)
    return Finding(subject="serial ports", passed=not closed, detail=detail)


def _model(config_path: Path) -> Finding:
    """Check the model as the daemon's account will: it cannot change the file, which is released and unchanged."""
    try:
        return model_finding(load_configuration(config_path))
    except ConfigurationError as error:
        return Finding(subject="thermal model", passed=False, detail=str(error))


def _clock() -> Finding:
    sane = time.time() > 1_700_000_000
    return Finding(
        subject="clock",
        passed=sane,
        detail=time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
        + ("" if sane else ": set it, history is dated by it"),
    )
