"""Builds the simulated machine that a command asks for and runs its faces."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from config.recordings.recording_map import RecordingMap
from config.schema import Configuration
from config.schema.cnc_drivers import OpcUaConfig
from daemon.simulation import SimulationError
from drivers.clock import ScaledClock
from drivers.contract import DriverError
from drivers.files.recording_csv import read_recording
from drivers.guard.speed_text import speed_program
from drivers.sim.contract import SimulatedMachine
from drivers.sim.faults import Fault, check_targets, load_faults
from drivers.sim.machine.day import Day
from drivers.sim.machine.machine import CfrpMachine
from drivers.sim.machine.packs import PackedMachine, load_pack_script
from drivers.sim.machine.recorded import RecordedMachine
from drivers.sim.machine.travel import axis_travels
from drivers.sim.nc.program import demo_program, standing_program
from drivers.sim.nc.safe_point import SafePointApplication, SpeedProgram
from drivers.sim.wires.opcua_server import ServerSecurity
from drivers.sim.wires.runner import Witness, run_simulated_machine
from drivers.sim.wires.source_wires import as_simulated
from models.recordings.dataset import Recording
from models.recordings.plausibility import RISES_FROM_DEGC, are_rises
from models.thermal.training.inputs import with_sensors

DEMO_SEED = 1000
"""The demo's day; the shipped model was fitted on other days (`daemon.simulation.simulated_model`)."""

Report = Callable[[dict[str, Any]], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class Simulation:
    """A machine and what it runs on."""

    machine: SimulatedMachine
    configuration: Configuration
    clock: ScaledClock
    witness: Witness | None = None

    async def run(
        self,
        directory: Path,
        *,
        faults_path: Path | None,
        until_s: float | None,
        report_s: float,
        report: Report,
        server_key: Path | None = None,
    ) -> None:
        """Run the machine's faces until cancelled; lines send from simulated time 0 on."""
        faults = read_faults(faults_path, self.configuration)
        try:
            await run_simulated_machine(
                self.machine,
                self.configuration,
                self.clock,
                directory=directory,
                faults=faults,
                report_period_s=report_s,
                report=self._with_channels(report),
                security=self._security(server_key),
                ready=lambda _: report({"ready": True}),
                own_process=True,
                first_pass_s=0.0,
                until_s=math.inf if until_s is None else until_s,
                witness=self.witness,
            )
        except (ValueError, OSError) as error:
            raise SimulationError(str(error)) from error

    def _security(self, server_key: Path | None) -> ServerSecurity | None:
        connection = self.configuration.cnc.connection
        if not isinstance(connection, OpcUaConfig) or server_key is None or (security := connection.security) is None:
            return None
        return ServerSecurity(
            user_name=security.user_name,
            password=security.password_file.read_text(encoding="utf-8").strip(),
            certificate=security.server_certificate,
            private_key=server_key,
            trusted_clients=(security.certificate,),
        )

    def _with_channels(self, report: Report) -> Report:
        machine = self.machine
        if not isinstance(machine, RecordedMachine):
            return report

        def extended(content: dict[str, Any]) -> None:
            played = {"channels": machine.channels(), "series": machine.series()}
            report(content | played if content.get("final") else content)

        return extended


def read_faults(path: Path | None, configuration: Configuration) -> tuple[Fault, ...]:
    """Return the faults of a script that this machine can have; raises SimulationError."""
    if path is None:
        return ()
    try:
        faults = load_faults(path)
        check_targets(faults, configuration)
    except ValueError as error:
        raise SimulationError(str(error)) from error
    return faults


def simulated_day(
    configuration: Configuration, clock: ScaledClock, seed: int | None, *, standing: bool = False
) -> Simulation:
    """Return the simulated CFRP machine on one of its days; `standing` at a safe point, or with the demo's program."""
    machine = CfrpMachine(
        Day.draw(DEMO_SEED if seed is None else seed, start="cold"),
        standing_program() if standing else demo_program(),
        [as_simulated(sensor) for sensor in configuration.temperatures.every_sensor],
        SafePointApplication(
            configuration.cnc.macros,
            configuration.compensation.outputs,
            configuration.cnc.guard,
            _speed_program(configuration),
        ),
        travels=axis_travels(configuration),
    )
    return Simulation(machine=machine, configuration=configuration, clock=clock)


def _speed_program(configuration: Configuration) -> SpeedProgram | None:
    if (tuning := configuration.spindle_speed) is None:
        return None
    return SpeedProgram(number=tuning.program, text=speed_program(configuration), macros=tuning.macros)


def packed_simulation(configuration: Configuration, clock: ScaledClock, path: Path, report: Report) -> Simulation:
    """Return the simulated machine, standing at a safe point, with one sensor moved between packs by a script."""
    try:
        script = load_pack_script(path)
    except ValueError as error:
        raise SimulationError(str(error)) from error
    line = next((line for line in configuration.temperatures.lines if script.sensor in line.sensor_ids), None)
    if line is None:
        raise SimulationError(f"{path}: sensor: there is no sensor {script.sensor}")
    machine = CfrpMachine(
        Day.draw(DEMO_SEED, start="cold"),
        standing_program(),
        configuration.temperatures.sensors,
        SafePointApplication(configuration.cnc.macros, configuration.compensation.outputs),
    )
    packed = PackedMachine(machine, script, line.name, clock, report)
    return Simulation(machine=packed, configuration=configuration, clock=clock, witness=packed)


def recorded_simulation(
    configuration: Configuration,
    clock: ScaledClock,
    path: Path,
    *,
    recording_map: RecordingMap,
    hours: tuple[float, float] | None,
) -> Simulation:
    """Return a machine that plays a part of a recording."""
    try:
        whole = read_recording(path, recording_map)
        measured_um = whole.without_impossible().displacements_um  # no error of the machine
        recording = as_sent(replace(whole, displacements_um=measured_um))
        if hours is not None:
            recording = recording.between_hours(*hours)
        followed = tuple(axis.estimate for axis in configuration.compensation.outputs.values() if axis.estimate)
        if set(followed) <= set(recording.displacement_names):
            recording = recording.with_channels(tuple(dict.fromkeys(followed)))
        names = [sensor.part for sensor in configuration.temperatures.sensors]
        if set(names) <= set(recording.temperature_names):
            recording = with_sensors(recording, [*names, *configuration.cnc.axis_positions])
        machine = RecordedMachine(
            recording,
            configuration.temperatures.sensors,
            configuration.cnc.macros,
            configuration.compensation.outputs,
            configuration.cnc.guard,
            block_s=recording_map.sample_s,
            positions={name: axis.axis for name, axis in configuration.cnc.axis_positions.items()},
        )
    except (DriverError, ValueError) as error:
        raise SimulationError(str(error)) from error
    return Simulation(machine=machine, configuration=configuration, clock=clock)


def as_sent(recording: Recording) -> Recording:
    """Return a whole recording with temperatures that nodes can send: rises since the start begin at 20 degC."""
    if not are_rises(recording.temperatures_degc[:, : recording.sensors]):
        return recording
    offset_degc = np.where(np.arange(recording.temperatures_degc.shape[1]) < recording.sensors, RISES_FROM_DEGC, 0.0)
    return replace(recording, temperatures_degc=recording.temperatures_degc + offset_degc)
