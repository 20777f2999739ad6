"""Asks an agent over HTTP: one connection for each request, answers of bounded length."""

import asyncio

import h11

from drivers.mtconnect.xml import LONGEST_DOCUMENT

PIECE = 65_536
LONGEST_HEAD = 16_384


class HttpError(ValueError):
    """The answer is not HTTP, or none that is read here; the text says why."""


async def fetch(host: str, port: int, target: str) -> tuple[int, bytes]:
    """Return status and body of what lies at a target, whatever its status: an agent's errors are documents too.

    Raises OSError, and HttpError for what is no answer. The caller bounds the time.
    """
    reader, writer = await asyncio.open_connection(host, port)
    try:
        connection = h11.Connection(h11.CLIENT, max_incomplete_event_size=LONGEST_HEAD)
        name = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
        headers = [("Host", name), ("Accept", "application/xml, text/xml"), ("Connection", "close")]
        request = connection.send(h11.Request(method="GET", target=target, headers=headers))
        writer.write((request or b"") + (connection.send(h11.EndOfMessage()) or b""))
        return await _body(reader, connection)
    except h11.RemoteProtocolError as error:
        raise HttpError(f"it is no HTTP ({error})") from error
    finally:
        writer.transport.abort()


async def _body(reader: asyncio.StreamReader, connection: h11.Connection) -> tuple[int, bytes]:
    status, body = 0, bytearray()
    while True:
        event = connection.next_event()
        if event is h11.NEED_DATA:
            connection.receive_data(await reader.read(PIECE))
        elif isinstance(event, h11.Data):
            body += event.data
            if len(body) > LONGEST_DOCUMENT:
                raise HttpError(f"it is longer than {LONGEST_DOCUMENT} byte")
        elif isinstance(event, h11.EndOfMessage):
            return status, bytes(body)
        elif isinstance(event, h11.Response | h11.InformationalResponse):
            status = event.status_code
        else:
            raise HttpError("it ends before it is whole")
