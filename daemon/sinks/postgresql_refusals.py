"""What a database that refuses means for a person: which key of the configuration to look at."""

from psycopg import errors

from config.schema.sinks import PostgresqlConfig
from models.json_values import printable

READS_ONLY = "the server takes no writes: check that `host` is the primary one, and default_transaction_read_only"
HINTS = {
    "hot standby": READS_ONLY,
    "is read-only": READS_ONLY,
    "password authentication failed": "check `user_name` and `password_file`",
    "no password supplied": "the server asks for a password: give `password_file`",
    "pg_hba.conf": "let this computer in on the server (pg_hba.conf), and check `tls` and `user_name`",
    "certificate verify failed": (
        "its certificate is not valid now by this computer's clock, or is none that `ca_certificate` vouches for"
    ),
    "root certificate": "name a certificate in PEM by `ca_certificate`",
    "server certificate for": "`host` must be a name in its certificate",
    "does not support ssl": "the server has no TLS: switch it on there, or set `tls: false`",
    "resolve host": "no address is known for `host`: check `host`",
    "translate host": "no address is known for `host`: check `host`",
    "connection refused": "check `host`, `port`, and that the server runs",
    "timeout expired": "check `host`, `port` and the network",
    "unreachable": "check `host` and the network of this computer",
    "no route": "check `host` and the network of this computer",
    "many clients": "the server lets no more connections in: raise its max_connections: each machine needs one",
    "connection slots": "the server lets no more connections in: raise its max_connections: each machine needs one",
    "authentication request": "what answers there is no PostgreSQL: check `host` and `port`",
    "invalid response": "what answers there is no PostgreSQL: check `host` and `port`",
    "connect privilege": "let `user_name` connect to `database` (GRANT CONNECT)",
    "permitted to": "let `user_name` log in (ALTER ROLE ... LOGIN)",
    "connections for": "the server lets `user_name` or `database` have no more connections: raise that limit",
    "currently accepting": "`database` is closed to everybody: open it (ALTER DATABASE ... ALLOW_CONNECTIONS true)",
    "statement timeout": "somebody keeps a table locked, or the server is slow: look there, or raise `timeout_s`",
    "no equivalent": "this `database` cannot hold every text: put all of it into one with ENCODING 'UTF8'",
    "database system": "the server is starting, stopping or recovering; it is tried again",
    "not write": "its disk may be full: free space on the server",
    "space left": "its disk may be full: free space on the server",
    "read-only transaction": READS_ONLY,
    "role ": "the server does not know the role: check `user_name`",
    "database ": "the server has no such database: check `database`",
}
"""What the server or the library says -> what to do, the first that fits."""


ALTERED = (
    *(errors.UndefinedTable, errors.UndefinedColumn, errors.DuplicateTable, errors.DatatypeMismatch),
    *(errors.InvalidColumnReference, errors.InvalidTextRepresentation, errors.IntegrityError, errors.RaiseException),
)
"""What a database says whose tables are not as the schema made them."""


LESS_THAN_BEFORE = (
    "it has less than it had while this sink was connected: it was restored, or toolpoint.deliveries was altered; what "
    "it lacks is sent again"
)


def refusal(error: Exception, config: PostgresqlConfig) -> str:
    """Return what went wrong, and what to do."""
    text = " ".join(str(error).split()) or type(error).__name__
    if isinstance(error, errors.InvalidSchemaName):  # it is there, and `user_name` does not see it
        return f"`user_name` {config.user_name} may not use schema toolpoint: let the role that owns it be `user_name`"
    if isinstance(error, errors.InsufficientPrivilege):
        return (
            f"`user_name` {config.user_name} may not do this ({text}): let it create in `database`, and own schema "
            "toolpoint and its tables"
        )
    if isinstance(error, errors.DiskFull):
        return f"its disk is full ({text}): free space on the server"
    if isinstance(error, ALTERED):
        return f"{error.diag.message_primary}: somebody has altered the tables in schema toolpoint: put them back"
    remedy = next((remedy for sign, remedy in HINTS.items() if sign in text.lower()), "it is tried again")
    return f"{text}: {remedy}"


def newer_schema(there: int, known: int) -> str:
    """Return that the database was brought up to date by a version that comes after this one."""
    return (
        f"its schema has version {there}, this version of toolpoint knows up to {known}; install the newer version on "
        "this computer too, or give another `database`"
    )


def other_encoding(encoding: str) -> str:
    """Return that the database has no room for some texts."""
    return (
        f"it has the encoding {encoding}, which does not hold every text: make it anew with "
        "CREATE DATABASE ... ENCODING 'UTF8' LOCALE 'C' TEMPLATE template0, or give another `database`"
    )


def name_taken(machine: str) -> str:
    """Return that another store, or a copy of this one, sends under the name of this machine."""
    return (
        f"another store, or this one on another computer, has sent as {machine} in the last minute: `machine` must "
        "differ from computer to computer; a store that was restored, moved or begun anew waits this minute"
    )


def left_out(count: int, last: str) -> str:
    """Return that messages were acknowledged which are no rows, so that nobody has them any more."""
    return f"{count} of them are no rows that the database takes and were left out, the last one: {last}"


def less_than_stored(machines: list[str]) -> str:
    """Return that rows are lost which the broker has no more, though the machines have."""
    names = printable(", ".join(machines))
    return (
        f"`database` has less of {names} than this store had put there: it was restored or made anew, or "
        "toolpoint.deliveries was altered: let these machines send again (docs/how-to/run-a-plant.md)"
    )
