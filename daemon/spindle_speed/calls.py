"""Takes the calls of the speed program: each once, whole, and joined with a poll that came after it."""

from dataclasses import dataclass, replace

from config.schema import Configuration
from config.schema.cnc_drivers import LATEST_T
from config.schema.spindle_speed import SpeedOperationConfig, SpindleSpeedConfig
from daemon.cnc.limits import guard_programs
from daemon.spindle_speed.macro_block import MacroValues, OperationKey, SpeedBlock, SpeedCall
from daemon.spindle_speed.messages import CalledOperation
from drivers.guard.speed_text import speed_text_number
from drivers.guard.text import GuardTextError
from models.records import CncRun, CncSample


@dataclass(frozen=True, slots=True, kw_only=True)
class SpeedOperation:
    """The operation under way, from its call to the next one."""

    made_for: OperationKey
    called: CalledOperation
    place: int | None
    """Of its configuration; None: not configured, or not to be tuned."""
    problem: str = ""
    """Why a call cannot be used; such an operation is not tuned."""

    @property
    def wanted(self) -> bool:
        return self.place is not None and not self.problem

    def same_as(self, other: "SpeedOperation | None") -> bool:
        """Whether the other one is the same operation, whatever program or subprogram its call was seen in."""
        return other is not None and (self.made_for, self.place) == (other.made_for, other.place)


class SpeedCalls:
    """Follows the counter of the calls; owned by the control task.

    A call counts once two readings have shown the same, so that none is taken half told, and once a poll came after
    the first of them, so that tool and program are those of the call. What polls show later in the operation changes
    nothing in it: a subprogram, a guard, a tool that is prepared.
    """

    def __init__(self, configuration: Configuration, tuning: SpindleSpeedConfig, block: SpeedBlock) -> None:
        self._tuning, self._block = tuning, block
        self._guard_programs = guard_programs(configuration)
        self._of_latest_t = configuration.cnc.tells_prepared_tool and tuning.tool_variable == LATEST_T
        """Call and polls tell the latest T word, so that they agree about a tool that is only prepared."""
        self.known_tool: int | None = None
        """In the spindle; None where that is not known."""
        self._text, self._text_problem = 0, ""
        try:
            self._text = speed_text_number(configuration)
        except GuardTextError as error:
            self._text_problem = str(error)
        self._taken: SpeedCall | None = None
        self._seen: tuple[SpeedCall, float] | None = None
        self.waiting = False
        """A call has been seen and is not taken yet."""
        self.under_way: SpeedOperation | None = None
        self.absence = ""
        """Why the operation under way cannot be what the machine does now, '' when it can."""
        self._programs: set[int] = set()
        """Seen running since the operation's first call."""
        self._over = ""

    def configured(self, operation: SpeedOperation) -> SpeedOperationConfig | None:
        return None if operation.place is None else self._tuning.operations[operation.place]

    def update(self, found: MacroValues, now_s: float, sample: CncSample) -> bool:
        """Take the macros that were read just now; return whether another operation has begun."""
        begun = self._taken_up(found, now_s, sample)
        if begun:
            self._programs, self._over = set(), ""
        self.absence = self._absence(sample)
        return begun

    def _absence(self, sample: CncSample) -> str:
        """Return why the operation cannot go on: another tool is in the spindle, or a reset has ended it for good.

        Its numbers may come again in another program or with another tool; the NC would then take the pair at once.
        """
        operation = self.under_way
        if operation is None or not operation.wanted:
            return ""
        strange = sample.program not in self._programs | self._guard_programs
        if sample.run is not CncRun.RESET:
            self._programs.add(sample.program)
        elif strange:
            self._over = (
                f"{operation.made_for} is over: the control is in reset in O{sample.program}; waiting for a call"
            )
        if self._over or sample.tool_number == operation.called.tool_number:
            return self._over or self._prepared(operation.called.tool_number)
        return f"T{sample.tool_number} is in the spindle, and {operation.made_for} is under way"

    def _taken_up(self, found: MacroValues, now_s: float, sample: CncSample) -> bool:
        call = self._block.call(found)
        told = call is not None and call != self._taken
        self.waiting = told or (call is None and self._taken is not None)
        if call is None or not told:
            self._seen = None
            return False
        if self._seen is None or self._seen[0] != call:
            self._seen = (call, now_s)
        if sample.time.monotonic_s <= self._seen[1] or sample.program in self._guard_programs:
            return False
        self._taken, self._seen, self.waiting = call, None, False
        before, operation = self.under_way, self._operation(call, sample)
        if before is not None and not self._over and operation.same_as(before):
            self.under_way = replace(before, problem=operation.problem)
            return False
        self.under_way = operation
        return True

    def _operation(self, call: SpeedCall, sample: CncSample) -> SpeedOperation:
        made_for = call.operation
        configured = None
        if made_for.kind > 0.0:
            configured = self._tuning.operation_of(int(made_for.tool_number), sample.program)
        return SpeedOperation(
            made_for=made_for,
            called=CalledOperation(
                tool_number=int(made_for.tool_number),
                program=sample.program,
                speed_rpm=made_for.speed_rpm,
                feed_mm_min=made_for.feed_mm_min,
                depth_mm=made_for.depth_mm,
                radial_mm=made_for.radial_mm,
            ),
            place=None if configured is None else self._tuning.operations.index(configured),
            problem=self._text_problem or self._disbelief(call, sample),
        )

    def _disbelief(self, call: SpeedCall, sample: CncSample) -> str:
        """Return why a call cannot be used, '' when it can."""
        if call.text != self._text:
            return (
                f"the control runs the text {call.text:.0f} of the speed program, this configuration makes "
                f"{self._text}: print it (`toolpoint guard --speed`) and load it"
            )
        if call.operation.tool_number != sample.tool_number:
            return (
                f"the call says tool {call.operation.tool_number:g} (#{self._tuning.tool_variable}), the CNC says "
                f"{sample.tool_number}: call after the tool change and before the next tool is prepared, or set "
                "spindle_speed.tool_variable"
            )
        return self._prepared(sample.tool_number)

    def _prepared(self, tool_number: int) -> str:
        """Return why the latest T word may not be the tool in the spindle, '' when it is."""
        if not self._of_latest_t or tool_number == self.known_tool:
            return ""
        return (
            f"T{tool_number} is the latest T word, which may only prepare a tool: let the program name the one in the "
            "spindle by the handshake before it calls, or set spindle_speed.tool_variable and cnc.focas.tool_macro"
        )
