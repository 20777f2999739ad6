"""The programs on the NC side: the guard macro and what belongs to it."""

from typing import Annotated, Literal

from pydantic import Field

from config.schema.base import READ_AHEAD_STOP_PATTERN, Name, Problems, Seconds, Section, checked

AxisLetter = Literal["X", "Y", "Z", "U", "V", "W", "A", "B", "C"]
USUAL_AXES: dict[str, tuple[AxisLetter, int]] = {"x": ("X", 1), "y": ("Y", 2), "z": ("Z", 3)}
"""Address letter and number of the axes whose names say which axis is meant."""
PROGRAMS = 5
"""Numbers that the programs take: guard, initialise, request, safe point begins, safe point ends."""
PROGRAM_LABELS = range(90_000, 91_000)
"""N numbers in the programs; the control reports them like any other, so none may mean anything in a part program."""
SHOWN = 2
"""R parameters in which a SINUMERIK's guard shows the daemon what its server does not: clock, count of power-ons."""
VACANT_R = -999_999_999.0
"""What an R parameter holds that is vacant: R parameters are always numbers, and nothing of ours is ever this one."""
SHARED_MEMORY = 4
"""Memory macros that all axes share: pending axis, planned value, offset before, offset after."""


class GuardAxisConfig(Section):
    """Which axis of the control an axis of the compensation is."""

    letter: AxisLetter = Field(description="its address letter; A, B and C turn, see `linear`", examples=["Z"])
    number: int = Field(ge=1, le=9, description="its axis number: its external offset is #5200 + number", examples=[3])
    linear: bool = Field(False, description="true: it is linear though its letter is A, B or C")


class GuardConfig(Section):
    """The guard macro that the CNC runs at safe points; `toolpoint guard` prints it."""

    dialect: Literal["fanuc", "sinumerik", "linuxcnc"] = Field(
        "fanuc",
        description="language of the programs: custom macro B, SINUMERIK with R parameters and SD43900, or LinuxCNC",
    )
    program: int = Field(
        9010,
        ge=1,
        le=9999 - PROGRAMS + 1,
        description=f"O number of the guard; {PROGRAMS} numbers from here are used, on a SINUMERIK {PROGRAMS + 1}",
    )
    memory: Annotated[int, Field(ge=500, le=999)] = Field(
        590,
        description=f"first macro of the guard's own memory, {SHARED_MEMORY} and one per axis; with slopes, but on a "
        "SINUMERIK, one more and one per slope; survives power-off, outside `writable`",
    )
    shown: Annotated[int, Field(ge=500, le=998)] = Field(
        580,
        description="SINUMERIK only: first of the two R parameters in which the guard shows the daemon the clock [s] "
        "and the count of power-ons; outside `writable`",
    )
    timer: int = Field(
        1, ge=1, le=99, description="SINUMERIK only: number of the $AC_TIMER that is the clock (MD28258)"
    )
    synchronised_action: int = Field(
        91, ge=1, le=199, description="SINUMERIK only: number (IDS) of the action that shows the clock"
    )
    axes: dict[Name, GuardAxisConfig] = Field(
        default_factory=dict,
        description="letter and number of each axis; needed for axes that are not called x, y or z",
        examples=[{"z": {"letter": "Z", "number": 3}}],
    )
    on_expiry: Literal["keep", "zero"] = Field(
        "keep", description="what an expired block does at a safe point: keep what is applied, or step to zero"
    )
    alarm: Literal["message", "stop"] = Field(
        "message", description="message: stops until cycle start (#3006); stop: alarm that ends the program (#3000)"
    )
    max_validity_s: Seconds = Field(120.0, description="a block that is valid for longer than this is refused [s]")
    increment_mm: float = Field(
        0.001, ge=1e-6, le=0.01, description="least increment of the control's offsets [mm] (IS-B 0.001, IS-C 0.0001)"
    )
    read_ahead_stop: Annotated[str, Field(pattern=READ_AHEAD_STOP_PATTERN)] = Field(
        "G53", description="block that ends the reading ahead on this control: G53, or an M code made for it"
    )
    watch_offset: bool | None = Field(
        None,
        description="read the external offset (#5201..) and the unit (#4006) with every poll, and end the reference "
        "when another than the guard has changed it; by default with the drivers focas and haas. Over OPC UA the "
        "server must have these system variables and `memory` as it has the macro variables",
        examples=[True],
    )
    request_timeout_s: Seconds = Field(10.0, description="how long the request program waits for an answer [s]")
    on_timeout: Literal["continue", "message", "stop"] = Field(
        "message", description="what the request program does without an answer"
    )

    @checked
    def _one_axis_each(self) -> Problems:
        taken: dict[str | int, str] = {}
        for name, axis in self.axes.items():
            if axis.letter in "ABC" and not axis.linear:
                yield ("axes", name, "letter"), f"{axis.letter} turns: 1 um would be 0.001 degrees there"
            for key, value in (("letter", axis.letter), ("number", axis.number)):
                if value in taken:
                    yield ("axes", name, key), f"{value} is {taken[value]} already"
                taken.setdefault(value, name)
        if self.read_ahead_stop in ("M98", "M99", "M30", "M2"):
            yield ("read_ahead_stop",), f"{self.read_ahead_stop} ends or calls a program"

    @property
    def programs(self) -> range:
        """Numbers of the NC programs; the last of a SINUMERIK's lets the clock run, and all others call it."""
        return range(self.program, self.program + PROGRAMS + (self.dialect == "sinumerik"))

    def number_of(self, axis: str) -> int | None:
        """Return the control's number of an axis, None where nothing says it."""
        return self.axes[axis].number if axis in self.axes else USUAL_AXES.get(axis.lower(), (None, None))[1]

    def memory_of(self, axes: int, slopes: int = 0) -> range:
        """Return the macros of the memory for so many axes, of which so many are slopes."""
        places = slopes + 1 if slopes and self.dialect != "sinumerik" else 0
        return range(self.memory, self.memory + SHARED_MEMORY + axes + places)
