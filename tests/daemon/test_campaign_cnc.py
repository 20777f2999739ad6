"""The simulated CNC of a fault campaign: what cuts a connection cuts that one only."""

from pathlib import Path

import pytest

from config.schema import Configuration
from daemon.cli.simulate.demo import demo_machine
from daemon.simulation.faults.cnc import CncFace
from daemon.simulation.faults.script import Happening, Incident
from daemon.simulation.processes import write_simulation_configuration
from drivers.sim.faults import FaultKind
from drivers.sim.machine.day import Day
from drivers.sim.machine.machine import CfrpMachine
from drivers.sim.nc.program import demo_program

CUT = Happening(kind=Incident.CUT_WRITE, at_s=10.0, amount=0.0, target=1)
KILLED = Happening(kind=FaultKind.KILLED_CNC, at_s=11.0, duration_s=20.0)


@pytest.fixture
def configuration(tmp_path: Path) -> Configuration:
    return write_simulation_configuration(demo_machine(), tmp_path, speed=1.0)[1]


@pytest.fixture
def face(configuration: Configuration) -> CncFace:
    sensors, macros = configuration.temperatures.sensors, configuration.cnc.macros
    axes = configuration.compensation.axes
    found = CncFace(CfrpMachine(Day.draw(1, start="cold"), demo_program(), sensors, macros, axes), macros, 1)
    assert found.connect()[0] == "ok"
    return found


def write(face: CncFace, configuration: Configuration) -> str:
    return face.write([(configuration.cnc.macros.sequence_a, 2.0)])[0]


def test_a_write_is_cut_and_the_next_connection_is_whole(face: CncFace, configuration: Configuration) -> None:
    face.begin(CUT, 10.0)
    assert write(face, configuration) == "lost"
    assert face.connect()[0] == "ok"
    assert write(face, configuration) == "ok"


def test_a_cut_that_met_a_lost_connection_cuts_no_other(face: CncFace, configuration: Configuration) -> None:
    """It cut the connection after the CNC was back, when all was taken to be over."""
    face.begin(CUT, 10.0)
    face.begin(KILLED, 11.0)
    assert write(face, configuration) == "lost"
    face.end(KILLED)
    face.connect()
    assert write(face, configuration) == "ok"
    face.begin(KILLED, 40.0)
    face.begin(CUT, 41.0)
    face.end(KILLED)
    face.connect()
    assert write(face, configuration) == "ok"
