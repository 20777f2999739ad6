"""Which module holds a command; the daemon, which is loaded by `toolpoint run`, needs none of the others."""

from types import ModuleType


def module_of(command: str) -> ModuleType:
    """Import the module whose function has the command's name."""
    match command:
        case "demo":
            from daemon.cli.simulate import demo

            return demo
        case "simulate":
            from daemon.cli.simulate import simulate

            return simulate
        case "replay":
            from daemon.cli.simulate import replay

            return replay
        case "faults":
            from daemon.cli.simulate import faults

            return faults
        case "latency":
            from daemon.cli.simulate import latency

            return latency
        case "status" | "monitor" | "reference" | "enable" | "disable" | "acknowledge":
            from daemon.cli.operate import operate

            return operate
        case "history" | "export":
            from daemon.cli.operate import history

            return history
        case "sink":
            from daemon.cli.operate import sink

            return sink
    return _module_of_group(command)


def _module_of_group(command: str) -> ModuleType:
    match command:
        case "fleet":
            from daemon.cli.fleet import group as fleet_group

            return fleet_group
        case "thermal":
            from daemon.cli.thermal import group as thermal_group

            return thermal_group
        case "stability":
            from daemon.cli.stability import group as stability_group

            return stability_group
        case "dynamics":
            from daemon.cli.dynamics import group as dynamics_group

            return dynamics_group
    return _module_of_admin(command)


def _module_of_admin(command: str) -> ModuleType:
    """Do so for what sets a machine up and looks after it."""
    match command:
        case "check" | "doctor":
            from daemon.cli.admin import doctor

            return doctor
        case "sources":
            from daemon.cli.admin import sources

            return sources
        case "cnc":
            from daemon.cli.admin import cnc

            return cnc
        case "guard":
            from daemon.cli.admin import guard

            return guard
        case "sample-config" | "config-schema":
            from daemon.cli.admin import configuration

            return configuration
        case "commission":
            from daemon.cli.admin import commission

            return commission
        case "backup" | "restore":
            from daemon.cli.admin import backup

            return backup
        case "model":
            from daemon.cli.admin import model

            return model
        case "keys":
            from daemon.cli.admin import keys

            return keys
        case "alarm":
            from daemon.cli.operate import alarm

            return alarm
        case "users":
            from daemon.cli.admin import users

            return users
    raise KeyError(command)
