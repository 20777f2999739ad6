"""A machine without physics for tests: whatever a test sets is what the faces show."""

import itertools
import socket
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from config.schema import Configuration
from config.schema.base import drivers_of
from config.schema.cnc import CncConfig, MacroMapConfig
from config.schema.cnc_drivers import OpcUaConfig, OpcUaSecurityConfig
from config.schema.compensation import AxisConfig, CompensationConfig
from config.schema.displacements import DisplacementChannelConfig, DisplacementFileConfig, DisplacementsConfig
from config.schema.temperatures import LineConfig, SensorConfig, TemperaturesConfig
from drivers.opcua.new_certificate import create_application_certificate
from drivers.sim.contract import AxisTruth
from drivers.sim.wires.opcua_server import ServerSecurity

USER, PASSWORD = "toolpoint", "a secret with blanks "
CLIENT_URI = "urn:test-computer:toolpoint"
SERVER_URI = "urn:toolpoint:simulated-cnc"
NAMESPACE = "urn:toolpoint:cnc"


class ScriptedMacros:
    """Macro variables #100-#199 and #500-#999, all vacant at first; remembers every write in order."""

    def __init__(self) -> None:
        self.values: dict[int, float | None] = dict.fromkeys(itertools.chain(range(100, 200), range(500, 1000)))
        self.written: list[tuple[int, float | None]] = []

    def get(self, number: int) -> float | None:
        return self.values[number]

    def set(self, number: int, value: float | None) -> None:
        if number not in self.values:
            raise KeyError(number)
        self.values[number] = value
        self.written.append((number, value))


class ScriptedNc:
    """State of an NC in MEM mode, started; its clock moves by a millisecond with every look at it."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        self.mode, self.run, self.alarm = 1, 3, 0
        self.program, self.sequence_number = 1000, 20
        self.spindle_speed_rpm, self.motor_temperature_degc = 5000.0, 31.5
        self.power_on_count, self.work_offset, self.tool_number = 7, 54, 3
        self.positions_mm = {"X": 100.0, "Y": 50.0, "Z": 250.0}
        self.external_mm = [0.0, 0.0, 0.0]
        self.macros = ScriptedMacros()
        self.clock_runs = True
        self._clock_s = 100.0

    @property
    def clock_s(self) -> float:
        self._clock_s += 0.001 if self.clock_runs else 0.0
        return self._clock_s


class _ShowingMacros(ScriptedMacros):
    """R580 and R581 show the clock and the count of power-ons, as a SINUMERIK's guard lets them."""

    def __init__(self, nc: ScriptedNc) -> None:
        super().__init__()
        self._nc = nc

    def get(self, number: int) -> float | None:
        return {580: lambda: self._nc.clock_s, 581: lambda: self._nc.power_on_count}.get(
            number, lambda: super(_ShowingMacros, self).get(number)
        )()


class ScriptedSinumerik(ScriptedNc):
    """The same control as a SINUMERIK with a guard."""

    def reset(self) -> None:
        super().reset()
        self.macros = _ShowingMacros(self)


class ScriptedMachine:
    """Registers are 0x190 plus the sensor's id; errors follow `truth_table`."""

    def __init__(self) -> None:
        self.time_s = 0.0
        self.nc = ScriptedNc()
        self.steps: list[float] = []
        # from_s, uncompensated, compensated, cutting
        self.truth_table: list[tuple[float, float, float, bool]] = []
        self.codes: dict[int, int] = {}

    def advance(self, to_s: float) -> None:
        if to_s > self.time_s:
            self.steps.append(to_s - self.time_s)
            self.time_s = to_s

    def register_codes(self, sensor_ids: Sequence[int]) -> list[int]:
        return [self.codes.get(sensor_id, 0x190 + sensor_id) for sensor_id in sensor_ids]

    def displacement_um(self) -> dict[str, float]:
        return {"x1": self.time_s / 60, "z": -1.5}

    def truth(self) -> dict[str, AxisTruth]:
        row = next((row for row in reversed(self.truth_table) if row[0] <= self.time_s), None)
        if row is None:
            return {}
        return {"Z": AxisTruth(uncompensated_um=row[1], compensated_um=row[2], cutting=row[3])}


def cnc_config(endpoint: str = "opc.tcp://127.0.0.1:0/cnc", **changes: Any) -> CncConfig:
    """A CNC with three axes; `changes` go to CncConfig or, for endpoint's siblings, to OpcUaConfig.

    With the section of another driver, such as `focas={"host": ...}`, that driver's CNC.
    """
    opcua = {key: changes.pop(key) for key in ("security", "nodes", "namespace_uri", "preset") if key in changes}
    changes.setdefault("allow_insecure_writes", opcua.get("security") is None)
    if opcua.get("preset") == "sinumerik":
        changes["guard"] = {"dialect": "sinumerik"} | changes.get("guard", {})
    if other := next((driver for driver in drivers_of(CncConfig) if driver in changes), None):
        changes["driver"] = other
        if other == "linuxcnc":
            changes.setdefault("guard", {"dialect": "linuxcnc"})
    else:
        changes["opcua"] = OpcUaConfig(**({"endpoint": endpoint, "namespace_uri": NAMESPACE} | opcua))
    changes.setdefault("timeout_s", 10.0)
    writable = changes.pop("writable", ["100-110", "500-520"])
    return CncConfig(
        macros=MacroMapConfig(
            writable=writable,
            sequence_a=500,
            values={"X": 501, "Y": 502, "Z": 503},
            valid_until=100,
            enable=504,
            sequence_b=505,
            check=506,
            echo_applied={"X": 510, "Y": 511, "Z": 512},
            echo_time=513,
            echo_status=514,
            echo_guard_version=515,
        ),
        **changes,
    )


GROUPS = (
    ((500, 1.0),),
    ((501, 0.001), (502, -0.002), (503, 0.0105), (100, 130.5), (504, 7.0), (506, 29_813.0)),
    ((505, 1.0),),
)
"""A whole block in the order in which the daemon writes it."""


def configuration(directory: Path, endpoint: str = "opc.tcp://127.0.0.1:0/cnc", **line: Any) -> Configuration:
    """Two lines: `spindle` with sensors 1-4 (3 infrared) and `column` with 11-13; two displacement channels."""
    infrared = {3}
    lines = {"spindle": ["1-4"], "column": ["11-13"]}
    return Configuration(
        machine="scripted",
        temperatures=TemperaturesConfig(
            lines=[
                LineConfig(name=name, port=str(directory / f"{name}.tty"), chain=list(chain), **line)
                for name, chain in lines.items()
            ],
            sensors=[
                SensorConfig(id=i, device="MLX90615" if i in infrared else "TMP102", component="test")
                for i in (1, 2, 3, 4, 11, 12, 13)
            ],
        ),
        displacements=displacements(directory),
        cnc=cnc_config(endpoint),
        compensation=CompensationConfig(
            axes={axis: AxisConfig(absolute_bound_um=50.0, slew_um_per_min=2.0, step_um=2.0) for axis in "XYZ"}
        ),
    )


def displacements(directory: Path, **file: Any) -> DisplacementsConfig:
    """Channels x1 and z (in mm, reversed) of a logger's file in a directory."""
    file = {"path": directory / "displacements.csv", "header": "Time"} | file
    return DisplacementsConfig(
        file=DisplacementFileConfig(**file),
        channels=[
            DisplacementChannelConfig(name="x1", column="X1"),
            DisplacementChannelConfig(name="z", column="Z", scale_um=-1000.0),
        ],
    )


class Keys:
    """Certificates and password of one client and one server, in a directory."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self.client, self.client_key = directory / "client.der", directory / "client.key"
        self.server, self.server_key = directory / "server.pem", directory / "server.key"
        self.password = directory / "password"
        create_application_certificate(
            self.client, self.client_key, application_uri=CLIENT_URI, host_name=socket.gethostname()
        )
        create_application_certificate(
            self.server, self.server_key, application_uri=SERVER_URI, host_name=socket.gethostname(), server=True
        )
        self.password.write_text(PASSWORD + "\n", encoding="utf-8")
        self.password.chmod(0o600)

    def client_config(self, **changes: Any) -> OpcUaSecurityConfig:
        """The security section of the client's configuration."""
        section = {
            "user_name": USER,
            "password_file": self.password,
            "certificate": self.client,
            "private_key": self.client_key,
            "server_certificate": self.server,
        }
        return OpcUaSecurityConfig(**(section | changes))

    def server_security(self, **changes: Any) -> ServerSecurity:
        """What the simulated server needs."""
        section = {
            "user_name": USER,
            "password": PASSWORD,
            "certificate": self.server,
            "private_key": self.server_key,
            "trusted_clients": (self.client,),
        }
        return ServerSecurity(**(section | changes))
