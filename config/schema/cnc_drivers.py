"""How the CNC is reached: the driver, and the section of the configuration that this driver reads.

To add a driver: a section (a `CncConnection`) here, its name in `CncDriverConfig.driver` with the field of that name
beside it, and one line in `drivers/registry.py`.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, Literal, Self, TypeVar
from urllib.parse import urlsplit

from pydantic import BaseModel, Field

from config.schema.base import (
    AGENT_PATTERN,
    ENDPOINT_PATTERN,
    Host,
    MacroNumber,
    Problems,
    Section,
    SectionOfDriver,
    checked,
)

Connection = TypeVar("Connection", bound="CncConnection")


class CncConnection(Section):
    """What every driver's section answers for itself, so that no other part has to know the driver."""

    driver: ClassVar[str]
    """Name of the driver, which is also the key of the section."""
    encryption_key: ClassVar[str] = ""
    """Key in the section that encrypts the connection; empty: the protocol cannot be encrypted."""
    read_only: ClassVar[bool] = False
    """Whether nothing is ever written over it."""

    @property
    def encrypted(self) -> bool:
        """Whether the connection is signed and encrypted and has a user."""
        return False

    @property
    def reads_speed(self) -> bool:
        """Whether spindle speed is asked for."""
        return True

    @property
    def address(self) -> str:
        """Where the CNC is, equal for every configuration that means the same one."""
        return self.model_dump_json()

    @property
    def secrets(self) -> dict[str, Path]:
        """Files with passwords and keys by their keys in the section: not shown, and in no back-up."""
        return {}

    def with_secrets(self, files: Mapping[str, Path]) -> Self:
        """Return a copy in which the secrets' keys name other files."""
        section = self
        for key, path in files.items():
            section = _with(section, key.split("."), path)
        return section


Changed = TypeVar("Changed", bound=BaseModel)


def _with(section: Changed, keys: list[str], value: Any) -> Changed:
    first, *rest = keys
    return section.model_copy(update={first: _with(getattr(section, first), rest, value) if rest else value})


class OpcUaSecurityConfig(Section):
    """User name and encryption of the OPC UA session."""

    user_name: str = Field(min_length=1, description="user name at the CNC's server", examples=["toolpoint"])
    password_file: Path = Field(
        description="file that holds the password, readable by the daemon only",
        examples=["/run/credentials/toolpoint.service/cnc-password"],
    )
    certificate: Path = Field(
        description="the daemon's certificate (DER or PEM)", examples=["/etc/toolpoint/pki/toolpoint.der"]
    )
    private_key: Path = Field(
        description="its private key (PEM), readable by the daemon only",
        examples=["/run/credentials/toolpoint.service/toolpoint-key.pem"],
    )
    server_certificate: Path = Field(
        description="the CNC's certificate; no other server is accepted", examples=["/etc/toolpoint/pki/cnc.der"]
    )

    @property
    def secrets(self) -> dict[str, Path]:
        """The password's file and the private key, by their keys in the section of the driver."""
        return {"security.password_file": self.password_file, "security.private_key": self.private_key}


NO_NODE = "none"
"""In place of an identifier: the control does not have it."""
NEEDED_NODES = ("mode", "run", "alarm", "macro")
"""What no control can be without."""
SINUMERIK_NAMESPACE = "SinumerikVarProvider"


class OpcUaNodesConfig(Section):
    """Identifiers of the CNC's variables in its OPC UA namespace (s=text or i=number); none: the control has no such.

    A key that is not given is the preset's.
    """

    mode: str | None = Field(
        None, description="operating mode: 0 MDI, 1 MEM, 3 EDIT, 4 HND, 5 JOG, 10 RMT", examples=["s=Mode"]
    )
    run: str | None = Field(
        None, description="0 reset, 1 stop, 2 hold, 3 start, 4 start (MSTR)", examples=["s=RunState"]
    )
    alarm: str | None = Field(None, description="not zero: an alarm is active", examples=["s=Alarm"])
    program: str | None = Field(
        None, description="O number of the main program, else of the running one", examples=["s=Program"]
    )
    sequence_number: str | None = Field(None, description="last N number passed", examples=["s=SequenceNumber"])
    spindle_speed: str | None = Field(None, description="actual spindle speed [1/min]", examples=["s=SpindleSpeed"])
    motor_temperature: str | None = Field(None, description="spindle motor [degC]", examples=["none"])
    clock: str | None = Field(None, description="the CNC's own clock [s]", examples=["s=Clock"])
    power_on_count: str | None = Field(None, description="rises with every power-on", examples=["s=PowerOnCount"])
    work_offset: str | None = Field(None, description="active work offset, 54..59", examples=["s=WorkOffset"])
    tool_number: str | None = Field(None, description="tool in the spindle", examples=["s=ToolNumber"])
    axis_position: str | None = Field(
        None,
        description="machine position of an axis; {axis} (its letter) or {number} is replaced",
        examples=["s=AxisPosition.{axis}"],
    )
    macro: str | None = Field(None, description="macro variable; {number} is replaced", examples=["s=Macro.{number}"])

    @checked
    def _sensible(self) -> Problems:
        if self.macro not in (None, NO_NODE) and "{number}" not in str(self.macro):
            yield ("macro",), "must contain {number}, which stands for the macro's number"
        position = self.axis_position
        if position not in (None, NO_NODE) and "{axis}" not in str(position) and "{number}" not in str(position):
            yield ("axis_position",), "must contain {axis} or {number}, which stand for the axis"
        elif absent := [name for name in NEEDED_NODES if getattr(self, name) == NO_NODE]:
            yield (absent[0],), "no control can be compensated without it: name its identifier"


class OpcUaConfig(CncConnection):
    """OPC UA connection to the CNC."""

    driver: ClassVar[str] = "opcua"
    encryption_key: ClassVar[str] = "security"

    endpoint: str = Field(
        pattern=ENDPOINT_PATTERN,
        description="address of the CNC's server: opc.tcp://host:port/path",
        examples=["opc.tcp://192.168.10.20:4840/cnc"],
    )
    preset: Literal["fanuc", "sinumerik", "generic"] = Field(
        "fanuc",
        description="identifiers and codes to begin with: fanuc (FANUC's codes; s=Mode and so on), sinumerik (a "
        "SINUMERIK's own server, R parameters as macros), generic (FANUC's codes, every identifier in `nodes`)",
    )
    namespace_uri: str | None = Field(
        None,
        min_length=1,
        description="namespace that holds the variables; needed but with preset sinumerik, which has its own",
        examples=["urn:toolpoint:cnc"],
    )
    nodes: OpcUaNodesConfig | None = Field(
        None, description="identifiers of variables, before those of the preset; none: the preset's alone"
    )
    security: OpcUaSecurityConfig | None = Field(
        None, description="Basic256Sha256, sign and encrypt, with a user; without it nothing is written"
    )

    @checked
    def _complete(self) -> Problems:
        if self.namespace_uri is None and self.preset != "sinumerik":
            yield ("namespace_uri",), "this key is required and missing: namespace that holds the variables"
        if self.preset == "generic":
            for name in NEEDED_NODES:
                if getattr(self.nodes, name, None) is None:
                    yield ("nodes", name), "this key is required and missing with preset generic"

    @property
    def namespace(self) -> str:
        """URI of the namespace that holds the variables."""
        return self.namespace_uri or SINUMERIK_NAMESPACE

    @property
    def encrypted(self) -> bool:
        """Whether the session is signed, encrypted and has a user."""
        return self.security is not None

    @property
    def reads_speed(self) -> bool:
        """Whether an identifier of the spindle speed is given, or the preset has one."""
        given = None if self.nodes is None else self.nodes.spindle_speed
        return self.preset != "generic" if given is None else given != NO_NODE

    @property
    def address(self) -> str:
        """The server's host and port."""
        return self.endpoint.removeprefix("opc.tcp://").partition("/")[0].lower()

    @property
    def secrets(self) -> dict[str, Path]:
        """The password's file and the private key."""
        return {} if self.security is None else self.security.secrets


LATEST_T = 4120
"""System variable of a FANUC that holds the latest T word, also where that only prepares a tool."""


class FocasConfig(CncConnection):
    """FOCAS2/Ethernet connection to a FANUC control; the protocol encrypts nothing and knows no user."""

    driver: ClassVar[str] = "focas"

    host: Host = Field(description="name or address of the control", examples=["192.168.10.20"])
    port: int = Field(8193, ge=1, le=65535, description="TCP port of its FOCAS2/Ethernet server")
    path: int = Field(1, ge=1, le=15, description="path (channel) of the control")
    tool_macro: MacroNumber = Field(
        LATEST_T,
        description="variable that holds the number of the tool in the spindle; 4120, the latest T word, may be that "
        "of the next one: where tools differ, the output holds until the program has named its tool",
    )
    motor_temperature_diagnosis: int | None = Field(
        None,
        ge=0,
        le=99999,
        description="number of the diagnosis that shows the spindle motor [degC]; none: not read",
        examples=[403],
    )
    library: Path | None = Field(
        None,
        description="FANUC's own library (libfwlib32.so of this computer's kind), asked by a process of its own; none: "
        "Toolpoint's own client, which needs no library",
        examples=["/opt/fanuc/libfwlib32-linux-x64.so"],
    )

    @property
    def address(self) -> str:
        """The control's host and port."""
        return f"{self.host.lower()}:{self.port}"


class HaasConfig(CncConnection):
    """Machine data collection of a Haas control; the protocol encrypts nothing and knows no user."""

    driver: ClassVar[str] = "haas"

    host: Host = Field(description="name or address of the control", examples=["192.168.10.20"])
    port: int = Field(5051, ge=1, le=65535, description="TCP port of its machine data collection (setting 143)")
    program_macro: MacroNumber = Field(4115, description="variable that holds the number of the program")
    sequence_number_macro: MacroNumber = Field(4114, description="variable that holds the last N number")
    work_offset_macro: MacroNumber = Field(4012, description="variable that holds the G code of the work offset")
    tool_macro: MacroNumber = Field(3026, description="variable that holds the number of the tool in the spindle")
    spindle_speed_macro: MacroNumber = Field(3027, description="variable that holds the spindle speed [1/min]")

    @property
    def address(self) -> str:
        """The control's host and port."""
        return f"{self.host.lower()}:{self.port}"


class LinuxcncConfig(CncConnection):
    """LinuxCNC on the daemon's own computer; nothing goes over a wire."""

    driver: ClassVar[str] = "linuxcnc"

    command: list[str] = Field(
        ["/usr/bin/python3"],
        min_length=1,
        description="Python that LinuxCNC was installed for, behind what runs it as LinuxCNC's user if that is another",
        examples=[["sudo", "-n", "-u", "cnc", "/usr/bin/python3"]],
    )
    nml_file: Path = Field(Path("/usr/share/linuxcnc/linuxcnc.nml"), description="LinuxCNC's list of its channels")
    analog_in: int = Field(0, ge=0, le=63, description="first of the analog inputs of motion that are ours: the clock")
    analog_out: int = Field(0, ge=0, le=63, description="first of the analog outputs of motion that are ours")

    @property
    def encrypted(self) -> bool:
        """Nothing goes over a wire: who may reach LinuxCNC's memory is decided by the computer's accounts."""
        return True

    @property
    def address(self) -> str:
        return "linuxcnc"


class MtconnectConfig(CncConnection):
    """An MTConnect agent, which is only read: state, program, speed; nothing can be compensated through it."""

    driver: ClassVar[str] = "mtconnect"
    read_only: ClassVar[bool] = True

    url: str = Field(
        pattern=AGENT_PATTERN,
        description="address of the agent: http://host:port",
        examples=["http://192.168.10.20:5000"],
    )
    position_items: dict[str, str] = Field(
        default_factory=dict,
        description="id or name of the data item of each axis' machine position, by the axis' letter",
        examples=[{"Z": "Zact"}],
    )
    device: str | None = Field(
        None, description="name or uuid of the device; none: the agent has only one", examples=["VMC-3Axis"]
    )
    spindle_speed_item: str | None = Field(
        None,
        description="id or name of the data item of the spindle's speed [1/min]; none: the only one of its type",
        examples=["S1speed"],
    )
    motor_temperature_item: str | None = Field(
        None,
        description="id or name of the data item of the spindle motor's temperature [degC]; none: not read",
        examples=["S1temp"],
    )

    @property
    def host(self) -> str:
        """Name or address of the agent."""
        return str(urlsplit(self.url).hostname)

    @property
    def port(self) -> int:
        return urlsplit(self.url).port or 80

    @property
    def path(self) -> str:
        """What stands before its pages."""
        return urlsplit(self.url).path.rstrip("/")

    @property
    def address(self) -> str:
        """The agent's host and port, and its device."""
        return f"{self.host.lower()}:{self.port}{self.path}" + (f" {self.device}" if self.device else "")

    @checked
    def _port_is_one(self) -> Problems:
        try:
            good = urlsplit(self.url).port != 0 and bool(urlsplit(self.url).hostname)
        except ValueError:
            good = False
        if not good:
            yield ("url",), "must be an address such as http://192.168.10.20:5000"


class CncDriverConfig(SectionOfDriver):
    """The driver and its section: a union that `driver` decides, with one key per driver."""

    driver: Literal["opcua", "focas", "haas", "linuxcnc", "mtconnect"] = Field(
        "opcua", description="how the CNC is reached; the section of that name says where"
    )
    opcua: OpcUaConfig | None = Field(
        None,
        description="OPC UA connection; required with driver opcua",
        examples=[{"namespace_uri": "urn:toolpoint:cnc"}],
    )
    focas: FocasConfig | None = Field(
        None, description="FOCAS2/Ethernet connection, which cannot be encrypted; required with driver focas"
    )
    haas: HaasConfig | None = Field(
        None, description="machine data collection of a Haas, which cannot be encrypted; required with driver haas"
    )
    linuxcnc: LinuxcncConfig | None = Field(None, description="LinuxCNC; required with driver linuxcnc")
    mtconnect: MtconnectConfig | None = Field(
        None, description="an MTConnect agent, which is only read; required with driver mtconnect"
    )
    allow_insecure_writes: bool = Field(
        False, description="write over an unencrypted or anonymous connection all the same (shown everywhere)"
    )

    @property
    def connection(self) -> CncConnection:
        section = getattr(self, self.driver)
        assert isinstance(section, CncConnection)
        return section

    def connection_as(self, kind: type[Connection]) -> Connection:
        """Return the section of the driver for a reader that knows one kind only; raises TypeError for another."""
        if not isinstance(section := self.connection, kind):
            raise TypeError(f"the configuration is for driver {self.driver}, not {kind.driver}")
        return section

    @property
    def encryption_key(self) -> str:
        """The key that encrypts the connection, from the top of the file; empty: the driver cannot."""
        key = self.connection.encryption_key
        return f"cnc.{self.driver}.{key}" if key else ""

    @property
    def insecure_advice(self) -> str:
        """What to do when nothing may be written because the connection is not encrypted."""
        if self.connection.read_only:
            return f"driver {self.driver} only reads; reach the control by another driver (cnc.driver) to compensate"
        allow = "set cnc.allow_insecure_writes: true"
        if self.encryption_key:
            return f"configure {self.encryption_key}, or, in a laboratory only, {allow}"
        return f"driver {self.driver} cannot encrypt; on a wire of its own, {allow}"
