"""A small interpreter for SINUMERIK programs: the statements that Toolpoint's programs need, errors for all others."""

from drivers.sim.nc.blocks import NcError
from drivers.sim.nc.sinumerik.control import SinumerikControl
from drivers.sim.nc.sinumerik.interpreter import SinumerikInterpreter
from drivers.sim.nc.sinumerik.program import SinumerikProgram, compile_archive

__all__ = ["NcError", "SinumerikControl", "SinumerikInterpreter", "SinumerikProgram", "compile_archive"]
