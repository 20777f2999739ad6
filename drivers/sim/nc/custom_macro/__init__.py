"""A small interpreter for FANUC custom macro B: the statements that Toolpoint's programs need, errors for all others.

The text is compiled once; afterwards it runs block by block, so that a reset can come between any two blocks.
"""

from drivers.sim.nc.blocks import NcError
from drivers.sim.nc.custom_macro.control import MacroControl
from drivers.sim.nc.custom_macro.interpreter import Interpreter
from drivers.sim.nc.custom_macro.program import MacroProgram, compile_programs

__all__ = ["Interpreter", "MacroControl", "MacroProgram", "NcError", "compile_programs"]
