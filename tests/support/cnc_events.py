"""What goes wrong in random histories of a control."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import yaml
from cnc_program import PROBES, SETS, TOOLS, Block
from cnc_wire import COUNTED, RUN_CODES, TOOLS_COUNTED, as_it_comes
from nc_requests import ACKNOWLEDGE, AXIS, COUNTER, KIND, VALUE

from daemon.backup.making import make_backup
from daemon.backup.restoring import restore
from drivers.sim.nc.custom_macro import MacroControl
from drivers.sim.nc.nc import ModeCode
from models.control.state import OperatorRequest
from models.records import CncRun

if TYPE_CHECKING:
    from cnc_histories import Shop

BLOCK = (500, 501, 502, 503, 120, 504, 505, 506)
ECHO = (511, 512, 513, 514, 515, 516)
MEMORY = tuple(range(590, 598))
REQUESTS = (COUNTER, KIND, AXIS, VALUE, ACKNOWLEDGE)


def some_value(shop: Shop) -> float | None:
    return shop.rng.choice([None, 0.0, -0.02, 0.02, 1e9, 0.005, -0.0005, 2.5, 1.0, shop.rng.uniform(-0.03, 0.03)])


def somebody_writes(numbers: Sequence[int], times: int = 1) -> Callable[[Shop], None]:
    def event(shop: Shop) -> None:
        for _ in range(times):
            shop.nc.macros.set(shop.rng.choice(numbers), some_value(shop))

    return event


def all_kept(value: float | None) -> Callable[[Shop], None]:
    def event(shop: Shop) -> None:
        for number in range(500, 580):
            shop.nc.macros.set(number, value)
        for number in range(590, 1000):
            shop.nc.macros.set(number, value)

    return event


def restored(shop: Shop) -> None:
    """The control's macro variables of a minute before come back, as from a back-up."""
    for number, value in shop.kept.items():
        shop.nc.macros.set(number, value)


def hand(shop: Shop) -> None:
    """An operator adds to the external offset."""
    axis = shop.rng.choice(shop.machine.offsets if shop.placed else list(shop.machine.places))
    um = shop.rng.choice([0.5, -5.0, 20.0])
    shop.nc.guard.change_own_offset(axis, um)
    shop.judge.by_hand[axis] += um


def reset_pressed(shop: Shop) -> None:
    shop.nc.run = CncRun.RESET
    top = shop.rng.random() < 0.5
    shop.undo.append((shop.turn_number + shop.rng.randrange(1, 12), lambda: shop.program.restart(from_the_top=top)))


def guard_broken(shop: Shop) -> None:
    shop.program.broken_after = shop.rng.randrange(20, 125)
    top = shop.rng.random() < 0.5
    shop.undo.append((shop.turn_number + shop.rng.randrange(6, 16), lambda: shop.program.restart(from_the_top=top)))


def guard_watched(shop: Shop) -> None:
    shop.program.watched_after = shop.rng.randrange(0, 125)


def feed_hold(shop: Shop) -> None:
    shop.nc.run = CncRun.HOLD
    shop.undo.append((shop.turn_number + shop.rng.randrange(1, 12), lambda: setattr(shop.nc, "run", CncRun.START)))


def switched_off(*, counted: bool) -> Callable[[Shop], None]:
    def event(shop: Shop) -> None:
        shop.power_cycle(counted=counted)
        top = shop.rng.random() < 0.5
        shop.undo.append((shop.turn_number + shop.rng.randrange(2, 12), lambda: shop.program.restart(from_the_top=top)))

    return event


def held_back(shop: Shop) -> None:
    shop.wire.held.clear()
    shop.undo.append((shop.turn_number + shop.rng.randrange(1, 4), shop.wire.held.set))


def answer(kind: str) -> Callable[[Shop], None]:
    """The n-th answer from now on is cut, doubled, split, lost, or comes behind or in place of an older one."""

    def event(shop: Shop) -> None:
        left, old = [shop.rng.randrange(0, 6)], [b""]

        def answers(data: bytes) -> Sequence[bytes | None]:
            left[0] -= 1
            if left[0] >= 0:
                old[0] = data
                return [data]
            shop.wire.answers = as_it_comes
            k = shop.rng.randrange(len(data) + 1)
            made: dict[str, list[bytes | None]] = {
                "cut": [data[:k], None],
                "twice": [data, data],
                "split": [data[i : i + 1] for i in range(len(data))],
                "lost": [b""],
                "late": [old[0], data],
                "instead": [old[0]],
            }
            return made[kind]

        shop.wire.answers = answers

    return event


def in_the_middle(event: Callable[[Shop], None]) -> Callable[[Shop], None]:
    """It happens between two requests of the daemon."""

    def later(shop: Shop) -> None:
        left = [shop.rng.randrange(1, 9)]

        def requests(data: bytes) -> Sequence[bytes | None]:
            left[0] -= 1
            if left[0] == 0:
                shop.wire.requests = as_it_comes
                event(shop)
            return [data]

        shop.wire.requests = requests

    return later


def request_cut(shop: Shop) -> None:
    left = [shop.rng.randrange(1, 9)]

    def requests(data: bytes) -> Sequence[bytes | None]:
        left[0] -= 1
        if left[0] > 0:
            return [data]
        shop.wire.requests = as_it_comes
        return [data[: shop.rng.randrange(len(data))], None]

    shop.wire.requests = requests


def clock_moves(shop: Shop) -> None:
    shop.nc.clock_zero_s += shop.rng.choice([-2000.0, -100.0, -3.0, -0.5, 0.5, 3.0, 100.0, 2000.0])


def inches(shop: Shop) -> None:
    """A program in inches, which calls the guard all the same."""
    control = shop.nc.guard.control
    modal, group, inch, metric = (
        (control.modal, 6, 20, 21) if isinstance(control, MacroControl) else (control.groups, 13, 1, 2)
    )
    modal[group] = inch
    shop.undo.append((shop.turn_number + shop.rng.randrange(1, 20), lambda: modal.__setitem__(group, metric)))


def shows(name: str, *values: Any) -> Callable[[Shop], None]:
    """The control shows something else for a while."""

    def event(shop: Shop) -> None:
        usual = getattr(shop.nc, name)
        setattr(shop.nc, name, shop.rng.choice(values))
        shop.undo.append((shop.turn_number + shop.rng.randrange(1, 12), lambda: setattr(shop.nc, name, usual)))

    return event


def another_offset(shop: Shop) -> None:
    values = {"focas": (55, 54.1, 54.4), "haas": (55, 110, 154)}.get(
        shop.served.dialect, (55, 505 if shop.siemens else 56)
    )
    shows("work_offset", *values)(shop)


def another_tool(shop: Shop) -> None:
    """A tool comes that the program has not called for, and goes again, as where a person looks at an edge."""
    usual = shop.nc.tool_number
    shop.change_tool(5)
    shop.undo.append((shop.turn_number + shop.rng.randrange(1, 12), lambda: shop.change_tool(usual)))


def next_tool_prepared(shop: Shop) -> None:
    """The program gets the next tool ready, which the control shows; where it is believed, once this one is named."""
    named = shop.rig is not None and shop.rig.control._measured.tool._named is not None
    if named or shop.tells_latest_t:
        shop.served.face.prepared = shop.rng.choice(TOOLS)


def nose_silent(shop: Shop) -> None:
    """No sensor of the nose is heard for a while."""
    shop.nose_silent = shop.rng.randrange(4, 100)


def refuses(shop: Shop) -> None:
    """The control refuses a macro variable for a while."""
    responder = shop.served.server.responder
    number = shop.rng.choice(BLOCK)
    if shop.served.dialect == "focas":
        responder.refused_macros[number] = shop.rng.choice([-1, 5, 7])
    else:
        responder.refused_macros.add(number)
    shop.undo.append((shop.turn_number + shop.rng.randrange(1, 12), responder.refused_macros.clear))


def sleeps(shop: Shop) -> None:
    """The daemon's computer does nothing for a while; the machine goes on."""
    shop.asleep = shop.rng.randrange(1, 40)


def restarts(shop: Shop) -> None:
    shop.restarts = True


def restarts_late(shop: Shop) -> None:
    restarts(shop)
    sleeps(shop)


def old_store(shop: Shop) -> None:
    """The store goes back to what it is now, as of a computer whose disk is put back, or of a second one."""
    store = shop.bench.configuration.history.path
    kept = {path.name: path.read_bytes() for path in store.parent.glob(f"{store.name}*") if path.is_file()}
    shop.then(shop.turn_number + shop.rng.randrange(2, 60), lambda shop: starts_on(shop, kept))


def empty_store(shop: Shop) -> None:
    """Another computer takes over, which has never seen this machine."""
    starts_on(shop, {})


def starts_on(shop: Shop, kept: dict[str, bytes]) -> None:
    store = shop.bench.configuration.history.path

    def put_back() -> None:
        for path in store.parent.glob(f"{store.name}*"):
            path.unlink()
        for name, content in kept.items():
            (store.parent / name).write_bytes(content)

    shop.restarts, shop.put_back = True, put_back
    shop.asleep = shop.rng.choice([0, 0, 10, 40])


def back_up(shop: Shop) -> None:
    """The back-up of now is restored later, by `toolpoint restore`."""
    folder = shop.bench.configuration.history.path.parent
    config_path, archive = folder / "toolpoint.yaml", folder / f"{len(shop.said)}.tar"
    content = json.loads(shop.bench.configuration.model_dump_json(exclude_defaults=True))
    config_path.write_text(yaml.safe_dump(content), encoding="utf-8")
    make_backup(shop.bench.configuration, config_path, archive)

    def comes_back(shop: Shop) -> None:
        shop.restarts = True
        shop.put_back = lambda: void(restore(archive, config_path, person="a person", replace=True))

    shop.then(shop.turn_number + shop.rng.randrange(2, 60), comes_back)


def calendar_set(shop: Shop) -> None:
    """Somebody sets this computer's calendar, or it learns the time: hours back, days ahead, or a little."""
    shop.bench.clock.calendar_s += shop.rng.choice([-7200.0, -3600.0, -30.0, -3.0, 3.0, 30.0, 3600.0, 3.0 * 86400.0])


def reference_late(shop: Shop) -> None:
    """The work is positioned next, its reference takes some seconds, and the calendar is set meanwhile."""
    estimation_is_slow(shop)
    shop.program.ahead.insert(0, Block(100, 5))
    shop.then(shop.turn_number + shop.rng.randrange(1, 14), calendar_set)


def estimation_is_slow(shop: Shop) -> None:
    shop.slow = shop.rng.randrange(1, 12)
    shop.undo.append((shop.turn_number + 40, lambda: setattr(shop, "slow", 0)))


def switched(shop: Shop) -> None:
    """A person switches everything off, asks for zero, or switches one axis off."""
    assert shop.rig is not None
    requests = (
        OperatorRequest(disable=frozenset(shop.machine.places)),
        OperatorRequest(zero=True),
        OperatorRequest(disable=frozenset({"z"})),
    )
    shop.rig.control.request(shop.rng.choice(requests), "a person")


def keep_backup(shop: Shop) -> None:
    """A back-up is taken now and comes back later."""
    shop.kept = {number: shop.nc.macros.get(number) for number in (*BLOCK, *ECHO, *MEMORY, *REQUESTS)}
    shop.undo.append((shop.turn_number + shop.rng.randrange(5, 40), lambda: restored(shop)))


def probes(shop: Shop) -> None:
    """The program measures the work at its next block, and waits until the daemon has taken it."""
    shop.program.ahead.insert(0, Block(PROBES, 1))


def jump(shop: Shop) -> None:
    """The machine grows by more than the output may follow at once, but not while work or tool is being measured."""
    if shop.program.block.number in (100, PROBES, SETS):
        shop.undo.append((shop.turn_number + 1, lambda: jump(shop)))
        return
    shop.judge.error[shop.rng.choice(list(shop.machine.places))] += shop.rng.choice([-8.0, 8.0])


def another_mode(shop: Shop) -> None:
    """The operator turns the mode switch, which stops the program, works by hand, and turns it back."""
    nc, face = shop.nc, shop.served.face
    program = nc.program
    face.mode, nc.run = shop.rng.choice((ModeCode.MDI, ModeCode.HANDLE, ModeCode.JOG, ModeCode.EDIT)), CncRun.STOP
    nc.program = shop.rng.choice((program, 0))
    top = shop.rng.random() < 0.5

    def back() -> None:
        face.mode, nc.program = ModeCode.MEM, program
        shop.program.restart(from_the_top=top)

    shop.undo.append((shop.turn_number + shop.rng.randrange(1, 12), back))


def guard_in_mdi(shop: Shop) -> None:
    """The same, and in MDI he calls the guard a few times."""
    another_mode(shop)
    shop.served.face.mode = ModeCode.MDI
    for _ in range(shop.rng.randrange(1, 4)):
        shop.nc.safe_point()


def counter_reset(shop: Shop) -> None:
    """The counter of positionings, or of parts, begins again."""
    counted = shop.nc.macros.get(COUNTED) or 0.0
    shop.nc.macros.set(COUNTED, shop.rng.choice([0.0, None, counted - 1.0, counted + 1.0]))


def tool_counter_reset(shop: Shop) -> None:
    """The counter of tool changes begins again, or somebody types into it."""
    counted = shop.nc.macros.get(TOOLS_COUNTED) or 0.0
    shop.nc.macros.set(TOOLS_COUNTED, shop.rng.choice([0.0, None, counted - 1.0, counted + 0.5, counted + 40.0]))


def another_modal(shop: Shop) -> None:
    """The program calls the guard in increments, with cutter compensation or in a canned cycle; a test of a program."""
    control = shop.nc.guard.control
    until = shop.turn_number + shop.rng.randrange(1, 20)
    if isinstance(control, MacroControl):
        group, code = shop.rng.choice([(3, 91), (7, 41), (9, 81)])
        usual = control.modal[group]
        control.modal[group] = code
        shop.undo.append((until, lambda: control.modal.__setitem__(group, usual)))
        return
    if shop.rng.random() < 0.5:
        control.groups[7] = 2
        shop.undo.append((until, lambda: control.groups.__setitem__(7, 1)))
    else:
        control.not_machining.add("$P_SIM")
        shop.undo.append((until, control.not_machining.clear))


EVENTS: dict[str, Callable[[Shop], None]] = {
    "foreign block": somebody_writes(BLOCK),
    "two foreign in the block": somebody_writes(BLOCK, 2),
    "foreign echo": somebody_writes(ECHO),
    "foreign memory": somebody_writes(MEMORY),
    "foreign request": somebody_writes(REQUESTS),
    "macros zeroed": all_kept(0.0),
    "macros vacant": all_kept(None),
    "backup restored": keep_backup,
    "hand in the offset": hand,
    "reset": reset_pressed,
    "guard broken off": guard_broken,
    "guard broken off again": guard_broken,
    "guard looked at": guard_watched,
    "feed hold": feed_hold,
    "switched off": switched_off(counted=True),
    "switched off, count the same": switched_off(counted=False),
    "wire reset": lambda shop: shop.wire.reset(),
    "held back": held_back,
    **{f"answer {kind}": answer(kind) for kind in ("cut", "twice", "split", "lost", "late", "instead")},
    "request cut": request_cut,
    "foreign in the middle": in_the_middle(somebody_writes(BLOCK)),
    "switched off in the middle": in_the_middle(lambda shop: shop.power_cycle()),
    "guard in the middle": in_the_middle(lambda shop: void(shop.nc.safe_point())),
    "clock moves": clock_moves,
    "inches": inches,
    "another program": shows("program", 2000, 9010, 0),
    "another work offset": another_offset,
    "another run state": shows("run", *RUN_CODES),
    "another block": shows("sequence_number", 900, 20),
    "another tool": another_tool,
    "another tool again": another_tool,
    "next tool prepared": next_tool_prepared,
    "next tool prepared then": next_tool_prepared,
    "nose silent": nose_silent,
    "nose silent again": nose_silent,
    "macro refused": refuses,
    **dict.fromkeys(("jump", "jump again", "jump then"), jump),
    "probe": probes,
    "probe again": probes,
    "daemon asleep": sleeps,
    "daemon restarted": restarts,
    "daemon restarted late": restarts_late,
    "store of before": old_store,
    "empty store": empty_store,
    "back-up restored by toolpoint": back_up,
    "calendar set": calendar_set,
    "reference late": reference_late,
    "estimation slow": estimation_is_slow,
    "switched": switched,
    "another mode": another_mode,
    "guard in MDI": guard_in_mdi,
    "part counter reset": counter_reset,
    "tool counter reset": tool_counter_reset,
    "another modal": another_modal,
}
ONLY = {"macro refused": ("focas", "haas")}


def void(_result: object) -> None:
    pass
