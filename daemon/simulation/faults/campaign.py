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
from daemon.simulation.faults.invariants import Claims, Ledger
from daemon.simulation.faults.models import OF_MODELS, CampaignModels, change_policy
from daemon.simulation.faults.observer import NAMES, Observer
from daemon.simulation.faults.operator import ROUND_S, Crowd, Person
from daemon.simulation.faults.process import WARM_UP_S, Acknowledgements, DaemonProcess, KillPlan, MemoryWatch
from daemon.simulation.faults.result import Result, progress_line
from daemon.simulation.faults.script import DAY_S, EPOCH_UTC_S, OF_A_PERSON, Happening, Incident, corrupt_from_s
from daemon.simulation.faults.store_check import StoreCheck
from drivers.sim.faults import FaultKind

GROWTH_MIB = 5.0
"""The daemon's memory may grow by so much after its first hour [MiB]."""
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
        progress: Callable[[str], None],
        script: Sequence[Happening],
        models: CampaignModels,
    ) -> None:
        self._configuration = configuration
        self._config_path = config_path
        self._directory = directory
        self._end_s = days * DAY_S
        self._seed = seed
        self._progress = progress
        ledger = self._ledger = Ledger(NAMES, tell=progress)
        self.result = Result(days=days, seed=seed, ledger=ledger)
        self._models = models
        self._seen = Observer(configuration, script, models, self.result, begun=self._begun, ended=self._ended)
        self._world = self._seen.world
        self._person = Person(configuration.service.socket, tuple(configuration.compensation.axes))
        self._crowd = Crowd(configuration.service.socket)
        sensors = {line.name: line.sensor_ids[0] for line in configuration.temperatures.lines}
        self._store = StoreCheck(configuration.history.path, sensors, ledger)
        self._acknowledged = Acknowledgements()
        self._process: DaemonProcess | None = None
        self._kills = KillPlan(configuration.cnc.macros.sequence_a)
        self._memory = MemoryWatch(min(WARM_UP_S, self._end_s / 4))
        self._open_intents = 0
        self._interrupted = False
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

    # --- starts and ends of the daemon -----------------------------------------------------------------

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
            self._config_path, epoch_utc_s=EPOCH_UTC_S, seed=seed, log_path=self._directory / "daemon.log"
        )
        self._memory.restarted(self._world.time_s)
        self._seen.restarted(self._world.time_s)
        if any(happening.kind is Incident.FULL_DISK for happening in self._world.active):
            self._process.fill_disk()
        return self._process

    def _after_end(self, killed: Happening) -> None:
        """Check what a killed daemon left; let the machine go on alone until the next one is started."""
        self._kills.clear()
        since_s = self._seen.follows_since_s
        settled = since_s is not None and self._world.time_s - since_s > SETTLED_S
        self._open_intents = 1 if settled else self._open_intents + 1
        self._bury()
        self._seen.hear(self._world.time_s, None)
        starts_s = corrupt_from_s(killed) if killed.kind is Incident.CORRUPT_START else killed.end_s
        until_s = max(starts_s, self._world.time_s)
        while self._world.time_s < until_s:
            self._world.advance(until_s)
            self._world.arrivals()
            self._kills.clear()
        self._seen.hear(self._world.time_s, None)

    def _bury(self) -> None:
        process, self._process = self._process, None
        assert process is not None
        self._person.hang_up()
        self._crowd.go()
        self._seen.operations.died(self._world.time_s)
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
            self._open_intents = self._open_intents if self._seen.follows_since_s is None else 0
            self._bury()
            self._store.audit(self._open_intents, self._seen.blocks, written=self.result.blocks > 0)
        self._store.acknowledged_cycles(self._acknowledged, all_of_them=True)
        self._store.displacements()
        self._store.probes(self._seen.operations.probes, list(self._configuration.compensation.axes))
        self._store.changes_of_state()
        result = self.result
        self._seen.finish()
        growth_mib = result.rss_growth_mib
        self._ledger.check("memory_growth", growth_mib <= GROWTH_MIB, f"{growth_mib:.2f} MiB in one life")
        result.acknowledged, result.lost = self._acknowledged.count, self._store.lost

    # --- the daemon's questions ---------------------------------------------------------------

    def _answer(self, name: str, time_s: float, raw: tuple[Any, ...], arguments: tuple[Any, ...]) -> Any:
        world = self._world
        claims = Claims(*raw) if raw else None
        world.settle(time_s)
        if name == "advance":
            self._seen.hear(time_s, claims)
            world.advance(min(arguments[0], self._end_s + STOP_S))
            return None
        world.move_machine()
        self._seen.hear(world.time_s, claims)
        match name:
            case "connect":
                return world.cnc.connect()
            case "read":
                answer = world.cnc.read(arguments[0])
                if answer[0] == "ok":
                    self._seen.polled(world.time_s)
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
            self._seen.group(group, taken=content is True)
            if verdict != "ok":
                return verdict, delay_s, content
            if delay_s > 0:
                return verdict, delay_s, (number, {})
        return "ok", 0.0, (len(groups), self._world.cnc.read_back())

    # --- what happens -----------------------------------------------------------------------

    def _begun(self, time_s: float, happening: Happening) -> None:
        process = self._process
        if happening.kind is Incident.FULL_DISK and process is not None:
            process.fill_disk()
        elif happening.kind in (Incident.KILLED_DAEMON, Incident.CORRUPT_START) and process is not None:
            self._kills.due = happening
        elif happening.kind is Incident.STORE_MOVED:
            self._store.move_away()
        elif happening.kind is Incident.HALF_OPEN:
            self._crowd.come()
        elif happening.kind is Incident.KILLED_IN_WRITE and process is not None:
            self._kills.in_write(happening)
        elif happening.kind is Incident.OTHER_POLICY:
            change_policy(self._config_path, zero_first=self._seen.operations.zero_first)
            self._kills.due = happening
        elif happening.kind is Incident.MODEL_RELOAD:
            self._models.exchange()
            self._seen.operations.released(time_s, self._models.model_id)
        elif happening.kind is Incident.DAMAGED_MODEL:
            self._models.damage()
        elif happening.kind in OF_A_PERSON:
            self._person.do(happening)
        if happening.kind in OF_MODELS and process is not None:
            process.reload_model()

    def _ended(self, happening: Happening) -> None:
        if happening.kind is Incident.FULL_DISK and self._process is not None:
            self._process.free_disk()
        if happening.kind in OF_A_PERSON:
            self._person.undo(happening)
        if happening.kind is Incident.HALF_OPEN:
            self._crowd.go()
        self._models.ended(happening)

    def _round(self) -> None:
        """Let the person look at the machine, and look at the daemon's memory."""
        world, seen = self._world, self._seen
        calm = not any(not isinstance(h.kind, FaultKind) for h in world.active)
        if seen.claims is not None and seen.claims.state == "FAULT" and calm:
            world.cnc.repair()
        seen.acknowledging |= self._person.round(world.time_s, seen.claims, calm=calm)
        world.at(world.time_s + ROUND_S, self._round)
        seen.round(world.time_s)
        if self._process is not None and self._memory.due(world.time_s):
            self._acknowledged.take(self._process)
            self._memory.look(world.time_s, self._process)
            self.result.rss_mib, self.result.rss_growth_mib = self._memory.rss_mib, self._memory.growth_mib
