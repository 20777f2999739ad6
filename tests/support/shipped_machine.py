"""The simulated machine's configuration, read once per process: nothing can change it, and it takes 60 ms to read."""

import functools

from config.loader import load_configuration
from config.machines import shipped_file
from config.schema import Configuration


@functools.cache
def shipped_machine() -> Configuration:
    return load_configuration(shipped_file("cfrpmt.yaml"))
