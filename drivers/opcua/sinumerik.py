"""The variables of a SINUMERIK in its own OPC UA server (SINUMERIK Integrate Access MyMachine / OPC UA), first channel.

Identifiers are the paths of NC variables; one with an index cannot be browsed. Numbers of R parameters stand for macro
numbers. The server has no clock that a guard could read too and no count of power-ons: the guard shows both in R
parameters. Identifiers are from the vendor's manuals and from programs that use them; none was tried on a control here.
"""

import re
import zlib
from collections.abc import Mapping

from config.schema.guard import VACANT_R
from drivers.opcua.variables import NodeMap, Reading
from models.records import CncMode, CncRun

R_PARAMETER = "s=/Channel/Parameter/R[u1,{number}]"
MODES = {0: CncMode.JOG, 1: CncMode.MDI, 2: CncMode.MEMORY}
"""opMode: JOG, MDA, AUTO."""
RUNS = {1: CncRun.HOLD, 2: CncRun.STOP, 3: CncRun.START, 4: CncRun.START, 5: CncRun.RESET}
"""progStatus: interrupted, stopped, running, waiting, aborted."""
NUMBERED_IN = frozenset({"", "_N_MPF_DIR", "_N_SPF_DIR", "_N_CUS_DIR", "_N_CMA_DIR"})
"""Folders in which a program's name alone says which program it is."""
FIRST_NAMED = 100_000_000
"""Programs whose names are no numbers are counted from here on."""
NAMED = 1_900_000_000
_PROGRAM = re.compile(r"(?:_N_)?(.*?)(?:[._][MS]PF)?", re.IGNORECASE)
_NUMBERED = re.compile(r"(?:O|TP)?([1-9]\d{0,7})")
_BLOCK = re.compile(r"[N:](\d{1,9})")
_OFFSET = re.compile(r"G(\d{2,3}(?:\.\d)?)(?:\s*P(\d{1,3}))?")
_TOOL = re.compile(r"T?\s*(\d{1,8})")


def sinumerik_map(shown: int) -> NodeMap:
    """Return the map of a control whose guard shows clock and count of power-ons from R parameter `shown` on."""
    return NodeMap(
        nodes={
            "mode": "s=/Bag/State/opMode[u1]",
            "run": "s=/Channel/State/progStatus[u1]",
            "alarm": "s=/Channel/State/chanAlarm[u1]",
            "program": "s=/Channel/ProgramInfo/workPandProgName[u1]",
            "sequence_number": "s=/Channel/ProgramInfo/blockNoStr[u1]",
            "spindle_speed": "s=/Channel/Spindle/actSpeed[u1,1]",
            "clock": R_PARAMETER.format(number=shown),
            "power_on_count": R_PARAMETER.format(number=shown + 1),
            "work_offset": "s=/Channel/SelectedFunctions/ncFkt[u1,8]",
            "tool_number": "s=/Channel/State/actTNumber[u1]",
            "axis_position": "s=/Channel/MachineAxis/actToolBasePos[u1,{number}]",
            "macro": R_PARAMETER,
        },
        modes=MODES,
        runs=RUNS,
        vacant=VACANT_R,
        texts=lambda: {"program": program_number, "sequence_number": block_number, "work_offset": offset_number},
    )


def program_number(path: str) -> float:
    """Return the number of a program: of O1000 or TP9010 what follows the letters, of another one a check sum.

    The same name gives the same number wherever and whenever it is read; two names give the same one by chance only
    (1 : 1.9e9). A program of a workpiece is named by its whole path. No program: 0.
    """
    path = path.strip()
    folder, _, name = path.rpartition("/")
    match = _PROGRAM.fullmatch(name)
    bare = match[1] if match else name
    numbered = _NUMBERED.fullmatch(bare.upper())
    if numbered and folder.strip("/").upper() in NUMBERED_IN:
        return float(numbered[1])
    return _named(path)


def block_number(text: str) -> float:
    """Return the N number of the block that runs; 0 for one without.

    The number of an earlier block would say that the program still stands there, and blocks between two polls are not
    seen: so a block without a number is no safe point and no positioning.
    """
    match = _BLOCK.match(text.strip().upper())
    return float(match[1]) if match else 0.0


def offset_number(text: str) -> float:
    """Return 54 for G54, 500 for G500, 541003 for G54.1 P3 and so on; raises ValueError for anything else."""
    if match := _OFFSET.fullmatch(text.strip().upper()):
        code = float(match[1])
        return code if match[2] is None else round(code * 10) * 1000 + float(match[2])
    raise ValueError("an active work offset (G500, G54 to G57, G505 ...) was expected")


def tool_number(name: str) -> float:
    """Return the number of a tool; of one with a name a check sum, 0 for none."""
    match = _TOOL.fullmatch(name.strip().upper())
    return float(match[1]) if match else _named(name.strip())


def _named(name: str) -> float:
    return float(FIRST_NAMED + zlib.crc32(name.upper().encode()) % NAMED) if name else 0.0


TEXTS: Mapping[str, Reading] = {
    "program": program_number,
    "sequence_number": lambda text: block_number("N" + text.strip().lstrip("Nn:")),
    "work_offset": lambda text: offset_number("G" + text.strip().lstrip("Gg")),
    "tool_number": tool_number,
}
"""What texts mean where another control has them in place of numbers."""
