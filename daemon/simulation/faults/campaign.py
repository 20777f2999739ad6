"""The fault campaign: days of a simulated machine and the real daemon, in virtual time.

The machine lives here and owns time; the daemon lives in a process of its own, asks for what happens
next whenever it is idle, and can be killed at any moment. See docs/how-to/run-a-fault-campaign.md.
"""

import contextlib
import signal
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from config.schema import Configuration
from daemon.simulation.faults.invariants import Claims, Ledger, WriteWatch
from daemon.simulation.faults.models import OF_MODELS, CampaignModels, change_policy
from daemon.simulation.faults.operations_check import HeartbeatWatch, OperationsWatch, Request
from daemon.simulation.faults.operator import ROUND_S, Person
from daemon.simulation.faults.process import WARM_UP_S, Acknowledgements, DaemonProcess, KillPlan, MemoryWatch
from daemon.simulation.faults.recovery import GoodInput, RecoveryWatch
from daemon.simulation.faults.result import Result, progress_line
from daemon.simulation.faults.script import DAY_S, OF_A_PERSON, Happening, Incident
from daemon.simulation.faults.store_check import StoreCheck
from daemon.simulation.faults.truth import TruthKeeper
from daemon.simulation.faults.world import CampaignWorld
from drivers.sim.faults import FaultKind
from drivers.sim.machine.day import Day
from drivers.sim.machine.machine import CfrpMachine
from drivers.sim.nc.program import campaign_program

NAMES = (
    *WriteWatch.NAMES,
    *OperationsWatch.NAMES,
    "state_after_fault",
    "fault_is_latched",
    "changes_of_state_known",
    "heartbeat",
    "acknowledged_cycles_kept",
    "audit_complete",
    "audit_has_every_block",
    "displacements_once",
    "probes_kept",
    "nothing_unexpected",
    "memory_growth",
)
GROWTH_MIB = 5.0
"""The daemon's memory may grow by so much after its first hour [MiB]."""
KEPT_BLOCKS = 100_000
SETTLED_S = 300.0
"""A daemon that has followed the CNC for so long has stored how the last life's open intent ended [s]."""
STOP_S = 120.0
"""At the end the daemon gets so much virtual time to stop [s]."""


class Campaign:
    """One campaign; run it once."""

    def __init__(
        self,
        configuration: Configuration,
        config_path: Path,
        directory: Path,
        *,
        days: float,
        seed: int,
        epoch_utc_s: float,
        progress: Callable[[str], None],
        script: Sequence[Happening],
        models: CampaignModels,
    ) -> None:
        """Prepare."""
        self._configuration = configuration
        self._config_path = config_path
        self._directory = directory
        self._end_s = days * DAY_S
        self._seed = seed
        self._epoch_utc_s = epoch_utc_s
        self._progress = progress
        ledger = self._ledger = Ledger(NAMES, tell=progress)
        self.result = Result(days=days, seed=seed, ledger=ledger)
        self._writes = WriteWatch(configuration, ledger)
        self._recovery = RecoveryWatch(ledger, configuration.compensation.output.min_confidence)
        lines = configuration.temperatures.lines
        machine = CfrpMachine(
            Day.draw(seed, start="cold"),
            campaign_program(),
            configuration.temperatures.sensors,
            configuration.cnc.macros,
            configuration.compensation.axes,
            configuration.cnc.guard,
        )
        self._models = models
        self._world = CampaignWorld(machine, configuration, script, self, epoch_utc_s=epoch_utc_s, seed=seed)
        self._operations = OperationsWatch(ledger, configuration.cnc.macros.request)
        self._truth = TruthKeeper(configuration, self._world, self._operations, models)
        self._heart = HeartbeatWatch(configuration.cnc.macros, ledger)
        self._person = Person(configuration.service.socket, tuple(configuration.compensation.axes))
        sensors = {line.name: line.sensor_ids[0] for line in lines}
        self._store = StoreCheck(configuration.history.path, sensors, ledger)
        self._acknowledged = Acknowledgements()
        self._process: DaemonProcess | None = None
        self._claims: Claims | None = None
        self._heard_at_s = 0.0
        self._case_kinds: set[str] = set()
        self._good_input = GoodInput([line.name for line in lines])
        self._kills = KillPlan(configuration.cnc.macros.sequence_a)
        self._memory = MemoryWatch(min(WARM_UP_S, self._end_s / 4))
        self._open_intents = 0
        self._follows_since_s: float | None = None
        self._blocks: list[float] = []
        self._interrupted = self._acknowledging = False
        self._world.at(ROUND_S, self._round)

    def run(self) -> Result:
        """Run it to its end, or to a Ctrl-C: then the days so far are what it found."""
        began = time.monotonic()
        before = signal.signal(signal.SIGINT, lambda *_: setattr(self, "_interrupted", True))
        next_progress_s = 0.0
        try:
            while self._world.time_s < self._end_s and not self._interrupted:
                self._live()
                if self._world.time_s >= next_progress_s:
                    next_progress_s = self._world.time_s + DAY_S / 24
                    self._progress(
                        progress_line(self.result, self._world.time_s, self._end_s, time.monotonic() - began)
                    )
            self.result.days = self._world.time_s / DAY_S
            self._finish()
        finally:
            signal.signal(signal.SIGINT, before)
            if self._process is not None:
                self._process.kill()
                self._bury()
        self.result.wall_s = time.monotonic() - began
        return self.result

    # --- the daemon's lives -----------------------------------------------------------------

    def _live(self) -> None:
        """Answer one question of the daemon; start it first where there is none."""
        process = self._process or self._start()
        message = process.channel.receive()
        if message is None:
            self._ledger.check("nothing_unexpected", False, f"{self._world.time_s:.1f} s: the daemon ended by itself")
            self._after_end(Happening(kind=Incident.KILLED_DAEMON, at_s=self._world.time_s, duration_s=10.0))
            return
        name, time_s, claims, arguments = message
        content = self._answer(name, time_s, claims, arguments)
        if self._kills.due is not None:
            process.kill()
            self._after_end(self._kills.due)
            return
        self._reply(process, content)

    def _reply(self, process: DaemonProcess, content: Any) -> None:
        world = self._world
        with contextlib.suppress(OSError):  # it has just died: the next question will not come
            process.channel.send((world.time_s, world.quiet_until_s, world.utc_step_s, world.arrivals(), content))

    def _start(self) -> DaemonProcess:
        self.result.lives += 1
        self._models.repair()
        seed = f"daemon {self._seed} {self.result.lives}"
        self._process = DaemonProcess(
            self._config_path,
            epoch_utc_s=self._epoch_utc_s,
            seed=seed,
            log_path=self._directory / "daemon.log",
        )
        self._memory.restarted(self._world.time_s)
        self._operations.restarted(self._world.time_s)
        self._heart.disturbed(self._world.time_s)
        self._follows_since_s = None
        self._acknowledging = False
        self._blocks = []
        self._writes.restarted(self._world.time_s)
        if any(happening.kind is Incident.FULL_DISK for happening in self._world.active):
            self._process.fill_disk()
        return self._process

    def _after_end(self, killed: Happening) -> None:
        """Check what a killed daemon left; let the machine go on alone until the next one is started."""
        self._kills.clear()
        since_s = self._follows_since_s
        settled = since_s is not None and self._world.time_s - since_s > SETTLED_S
        self._open_intents = 1 if settled else self._open_intents + 1
        self._bury()
        self._hear(self._world.time_s, None)
        until_s = max(killed.end_s, self._world.time_s)
        while self._world.time_s < until_s:
            self._world.advance(until_s)
            self._world.arrivals()
            self._kills.clear()
        self._hear(self._world.time_s, None)

    def _bury(self) -> None:
        process, self._process = self._process, None
        assert process is not None
        self._person.hang_up()
        self._operations.died(self._world.time_s)
        self._world.desert()
        process.wait()
        self._acknowledged.take(process)
        process.close()
        self._ledger.check("nothing_unexpected", not process.defects, "; ".join(process.defects[:2])[:2000])
        self._store.acknowledged_cycles(self._acknowledged)
        self._store.audit(self._open_intents, None, written=self.result.blocks > 0)

    def _finish(self) -> None:
        """Stop the daemon in order, and look at everything once more."""
        process = self._process
        if process is not None:
            process.ask_to_stop()
            until_s = self._world.time_s + STOP_S
            while self._world.time_s < until_s and (message := process.channel.receive()) is not None:
                name, time_s, claims, arguments = message
                self._reply(process, self._answer(name, min(time_s, until_s), claims, arguments))
            status = process.wait()
            self._ledger.check("nothing_unexpected", status == 0, f"the daemon ended with status {status}")
            self._open_intents = self._open_intents if self._follows_since_s is None else 0
            self._bury()
            self._store.audit(self._open_intents, self._blocks, written=self.result.blocks > 0)
        self._store.acknowledged_cycles(self._acknowledged, all_of_them=True)
        self._store.displacements()
        self._store.probes(self._operations.probes, list(self._configuration.compensation.axes))
        self._store.changes_of_state()
        result = self.result
        result.recovery_s = self._recovery.times_s
        result.not_judged = self._recovery.disturbed
        growth_mib = result.rss_growth_mib
        self._ledger.check("memory_growth", growth_mib <= GROWTH_MIB, f"{growth_mib:.2f} MiB in one life")
        result.acknowledged, result.lost = self._acknowledged.count, self._store.lost

    # --- the daemon's questions ---------------------------------------------------------------

    def _answer(self, name: str, time_s: float, raw: tuple[Any, ...], arguments: tuple[Any, ...]) -> Any:
        world = self._world
        claims = Claims(*raw) if raw else None
        world.settle(time_s)
        if name == "advance":
            self._hear(time_s, claims)
            world.advance(min(arguments[0], self._end_s + STOP_S))
            return None
        world.move_machine()
        self._hear(world.time_s, claims)
        match name:
            case "connect":
                return world.cnc.connect()
            case "read":
                answer = world.cnc.read(arguments[0])
                if answer[0] == "ok":
                    self._operations.polled(world.time_s, retreat_block=self._truth.at_retreat_block)
                    self._good_input.cnc()
                    self._note_good_input(world.time_s)
                return answer
            case "read_macros":
                return world.cnc.read_macros(arguments[0])
            case "write":
                return self._write(arguments[0])
            case "listen":
                return world.listen(arguments[0])
            case "leave":
                world.leave(arguments[0])
        return None

    def _write(self, groups: tuple[tuple[tuple[int, float], ...], ...]) -> Any:
        """Take the groups of a block one after the other; the content of the answer says how many were taken."""
        delay_s = 0.0
        for number, group in enumerate(groups, start=1):
            if self._kills.before(group):
                return None
            verdict, group_delay_s, content = self._world.cnc.write(group)
            delay_s += group_delay_s
            self._note_group(group, taken=content is True)
            if verdict != "ok":
                return verdict, delay_s, content
            if delay_s > 0:
                return verdict, delay_s, (number, {})
        return "ok", 0.0, (len(groups), self._world.cnc.read_back())

    def _note_group(self, group: tuple[tuple[int, float], ...], *, taken: bool) -> None:
        self._writes.group(self._world.time_s, group, self._claims, taken=taken)
        if taken and group[0][0] == self._configuration.cnc.macros.sequence_a:
            self.result.blocks += 1
            self._blocks.append(group[0][1])
            del self._blocks[:-KEPT_BLOCKS]
        request = self._configuration.cnc.macros.request
        if taken and request is not None and group[0][0] == request.acknowledge:
            self._writes.mark(self._world.time_s, self._operations.answered(self._world.time_s, group[0][1]))

    # --- what is watched ------------------------------------------------------------------------

    def cycle(self, time_s: float, line: str, *, whole: bool, heard: bool) -> None:
        """Take the end of a pass (`daemon.simulation.faults.world.Watcher`)."""
        self.result.cycles += 1
        self._truth.cycle(time_s, whole=whole, heard=heard)
        if whole:
            self._good_input.cycle(line)
            self._note_good_input(time_s)

    def applied(self, time_s: float, applied_um: dict[str, float], cutting: bool) -> None:
        """Take what the NC applies."""
        self._writes.applied(time_s, applied_um, cutting=cutting)

    def asked(self, time_s: float, counter: int, kind: int, axis: int, value_mm: float) -> None:
        """Take a request of the NC program."""
        self._operations.asked(Request(time_s=time_s, counter=counter, kind=kind, axis=axis, value_mm=value_mm))

    def begun(self, time_s: float, happening: Happening) -> None:
        """Take the begin of an incident."""
        self._operations.begun(time_s, happening)
        self._truth.begun(happening)
        self._heart.disturbed(happening.end_s)
        self.result.incidents[happening.kind.value] += 1
        self._recovery.begun(happening.kind.value)
        self._case_kinds.add(happening.kind.value)
        process = self._process
        if happening.kind is Incident.FULL_DISK and process is not None:
            process.fill_disk()
        elif happening.kind is Incident.KILLED_DAEMON and process is not None:
            self._kills.due = happening
        elif happening.kind is Incident.KILLED_IN_WRITE and process is not None:
            self._kills.in_write(happening)
        elif happening.kind is Incident.OTHER_POLICY:
            change_policy(self._config_path, zero_first=self._operations.zero_first)
            self._kills.due = happening
        elif happening.kind is Incident.MODEL_RELOAD:
            self._models.exchange()
            self._memory.restarted(time_s)
            self._operations.released(time_s, self._models.model_id)
        elif happening.kind is Incident.DAMAGED_MODEL:
            self._models.damage()
        elif happening.kind in OF_A_PERSON:
            self._person.do(happening)
        if happening.kind in OF_MODELS and process is not None:
            process.reload_model()

    def ended(self, time_s: float, happening: Happening) -> None:
        """Take its end."""
        if happening.kind is Incident.FULL_DISK and self._process is not None:
            self._process.free_disk()
        if happening.kind in OF_A_PERSON:
            self._person.undo(happening)
        self._models.ended(happening)
        self._operations.ended(happening)
        self._good_input.after(happening)
        if not self._world.active:
            self._recovery.over(self._case_kinds)
            self._case_kinds = set()

    def _round(self) -> None:
        """Let the person look at the machine, and look at the daemon's memory."""
        world = self._world
        calm = not any(not isinstance(h.kind, FaultKind) for h in world.active)
        if self._claims is not None and self._claims.state == "FAULT" and calm:
            world.cnc.repair()
        self._acknowledging |= self._person.round(world.time_s, self._claims, calm=calm)
        world.at(world.time_s + ROUND_S, self._round)
        self._operations.round(world.time_s, self._claims)
        if self._claims is not None:
            self._heart.look(world.time_s, self._claims, world.machine.nc)
            if self._models.is_watching(self._claims.model):
                for happening in (h for h in world.active if h.kind is Incident.WRONG_SENSOR):
                    self._operations.wrong_sensor(world.time_s, happening, self._claims)
        if self._process is not None and self._memory.due(world.time_s):
            self._acknowledged.take(self._process)
            self._memory.look(world.time_s, self._process)
            self.result.rss_mib, self.result.rss_growth_mib = self._memory.rss_mib, self._memory.growth_mib

    def _hear(self, time_s: float, claims: Claims | None) -> None:
        """Take what the daemon says of itself at a time; count how long it was in its state."""
        state = self._claims.state if self._claims is not None else "not running"
        states_s = self.result.states_s
        states_s[state] = states_s.get(state, 0.0) + max(0.0, time_s - self._heard_at_s)
        self._heard_at_s = max(time_s, self._heard_at_s)
        before = self._claims
        self._claims = claims
        if claims is None:
            return
        if self._follows_since_s is None:
            self._follows_since_s = time_s
        if before is not None and before.state == "FAULT" and claims.state != "FAULT":
            self._world.cnc.forgiven()
            self._recovery.left_fault(time_s, acknowledged=self._acknowledging)
            self._acknowledging = False
        self._writes.heard(time_s, claims)
        self._truth.heard(time_s, claims)
        self._operations.heard(time_s, claims, self._truth.applied_um)
        self._writes.input_is(time_s, good=self._truth.temperatures(time_s), echo_known=self._truth.echo_known)
        self._note_good_input(time_s)
        if self._recovery.open:
            self._recovery.look(time_s, self._truth.at(time_s, claims), claims)

    def _note_good_input(self, time_s: float) -> None:
        """Begin to count when the first good input has arrived; what the daemon claims is still from before it."""
        if self._claims is not None and self._recovery.waiting and self._good_input.there:
            self._recovery.good_input(time_s, self._claims)
