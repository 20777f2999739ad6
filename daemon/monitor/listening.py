"""The sockets that others connect to over the network, and how their addresses are written."""

import socket


def listening(host: str, port: int, waiting: int) -> socket.socket:
    """Return a socket that listens on an address of IPv4 or IPv6; `waiting` connections wait until they are taken."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    return socket.create_server((host, port), family=family, backlog=waiting)


def in_url(host: str, port: int) -> str:
    """Return address and port as they stand in a URL."""
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
