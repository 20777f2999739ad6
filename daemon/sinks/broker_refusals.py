"""What a broker that refuses means for a person: which key of the configuration to look at."""

import socket
import ssl

from config.schema.sinks import BrokerConfig
from daemon.sinks.vouching import unvouched
from models.json_values import printable

REFUSED = {
    130: "if that comes each time, a message is larger than the broker takes (mosquitto: message_size_limit): raise it",
    132: "it does not speak MQTT 5: upgrade it, or give another `host`",
    134: "check `user_name` and `password_file`",
    135: "check `user_name` and `password_file`, and that the broker lets this user in and publish here",
    137: "the broker is busy or full: it is tried again",
    138: "the broker keeps `user_name` or this computer out: let it in there",
    142: "another client took the place of this one: `machine` and the sink's `name` together must be given only once",
    149: "a message is larger than the broker takes (mosquitto: max_packet_size): raise it there",
    151: "its quota is used up: raise it there",
    154: "it must keep retained messages (mosquitto: retain_available): let it",
    155: "it must take quality of service 1 (mosquitto: max_qos): let it",
}
"""Reason codes of MQTT 5 -> what to do."""
UNSPECIFIED = 128


def refusal(error: Exception, config: BrokerConfig) -> str:
    """Return why no connection came about, and what to do."""
    text = " ".join(str(error).split()) or type(error).__name__
    if isinstance(error, ssl.SSLCertVerificationError):
        return unvouched(error, "host")
    if isinstance(error, ssl.SSLError) or (config.tls and isinstance(error, ConnectionResetError | BrokenPipeError)):
        return f"{text}: it speaks no TLS at this port: check `port`, switch TLS on there, or set `tls: false`"
    if isinstance(error, socket.gaierror | UnicodeError):
        return f"{text}: no address is known for `host`: check `host`"
    return f"{text}: check `host`, `port` ({config.server_port}), the network, and that the broker runs"


def reason(code: int, name: str) -> str:
    return f"{name}: {REFUSED.get(code, 'it is tried again')}"


def lost(code: int, name: str) -> str:
    """Return that the connection ended; not every broker tells whom it threw out that another came in its place."""
    if code != UNSPECIFIED:
        return f"the connection was lost: {reason(code, name)}"
    return (
        "the connection was lost: it is tried again; if it is lost every time, another client has the same name: "
        "`machine` and the sink's `name` together must be given only once"
    )


def closed_at_once(config: BrokerConfig) -> str:
    """Return that the broker ended the connection without a word."""
    asked = "set `tls: true`" if not config.tls else "check `port`"
    return (
        f"it closed the connection before it answered: perhaps its port {config.server_port} is another: {asked}; or "
        "it does not speak MQTT 5, for Sparkplug at least 3.1.1"
    )


def unanswered(config: BrokerConfig) -> str:
    return (
        f"no answer within `timeout_s` ({config.timeout_s:g} s): check `port`, and that it speaks MQTT 5, for "
        "Sparkplug at least 3.1.1"
    )


def may_not_publish(topic: str, name: str) -> str:
    """Return that the broker's list of rights has no room for this."""
    return f"{name}: `user_name` may not publish to {topic}: let it (the broker's access list), or give other topics"


def may_not_subscribe(topic: str, name: str) -> str:
    """Return that the broker's list of rights has no room for this."""
    return f"{name}: `user_name` may not subscribe to {topic}: let it (the broker's access list), or give other topics"


def own_unheard(topic: str) -> str:
    """Return that what was published did not come back: the specification has no acknowledgement for it."""
    return (
        f"{topic} did not come back: let `user_name` publish and subscribe there (the broker's access list), and look "
        "whether the broker drops large messages (mosquitto: message_size_limit)"
    )


def primary_host_offline(topic: str) -> str:
    """Return that data wait for the host that is to have them."""
    return f"`primary_host` is not online by its topic {topic}, so the history waits: start that host, and check its ID"


def primary_host_went(topic: str) -> str:
    """Return why the session was ended."""
    return f"`primary_host` went offline by its topic {topic}: the history waits for it"


def name_in_use(machine: str, topic: str) -> str:
    return (
        f"another store sends as {machine}, which it says at {topic}, so the history of this one waits: `machine` must "
        "differ from computer to computer"
    )


def two_computers(machines: list[str]) -> str:
    """Return that rows of two computers stand under one name."""
    names = printable(", ".join(machines))
    return f"two computers send as {names}, and their rows are mixed: `machine` must differ from computer to computer"


def nobody_subscribes(topics: list[str]) -> str:
    """Return that rows would reach nobody."""
    return (
        f"nobody has subscribed to {', '.join(topics)}, so these rows wait: start what reads them, or take them out of "
        "`history`"
    )


def no_acknowledgement(config: BrokerConfig) -> str:
    return f"no acknowledgement within `timeout_s` ({config.timeout_s:g} s): look at the broker and the network"
