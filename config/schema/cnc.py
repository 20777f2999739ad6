"""The CNC: how it is reached, and which of its macro variables are ours."""

from functools import cached_property
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from config.schema.base import MacroNumber, Name, Seconds, Section
from config.schema.temperatures import expand_ranges

MacroRange = Annotated[str, Field(pattern=r"^\d+(-\d+)?$")]


class OpcUaSecurityConfig(Section):
    """User name and encryption of the OPC UA session."""

    user_name: str = Field(description="user name at the CNC's server")
    password_file: Path = Field(description="file that holds the password, readable by the daemon only")
    certificate: Path = Field(description="the daemon's certificate (DER or PEM)")
    private_key: Path = Field(description="its private key (PEM)")
    server_certificate: Path = Field(description="the CNC's certificate; no other server is accepted")


class OpcUaNodesConfig(Section):
    """Identifiers of the CNC's variables in its OPC UA namespace (s=text or i=number)."""

    mode: str = Field("s=Mode", description="operating mode: 0 MDI, 1 MEM, 3 EDIT, 4 HND, 5 JOG, 10 RMT")
    run: str = Field("s=RunState", description="0 reset, 1 stop, 2 hold, 3 start, 4 start (MSTR)")
    alarm: str = Field("s=Alarm", description="not zero: an alarm is active")
    program: str = Field("s=Program", description="O number of the running program")
    sequence_number: str = Field("s=SequenceNumber", description="last N number passed")
    spindle_speed: str = Field("s=SpindleSpeed", description="actual spindle speed [1/min]")
    motor_temperature: str = Field("s=SpindleMotorTemperature", description="spindle motor [degC]")
    clock: str = Field("s=Clock", description="the CNC's own clock [s]")
    power_on_count: str = Field("s=PowerOnCount", description="rises with every power-on")
    work_offset: str = Field("s=WorkOffset", description="active work offset, 54..59")
    tool_number: str = Field("s=ToolNumber", description="tool in the spindle")
    macro: str = Field("s=Macro.{number}", description="macro variable; {number} is replaced")


class OpcUaConfig(Section):
    """OPC UA connection to the CNC."""

    endpoint: str = Field(pattern=r"^opc\.tcp://", description="opc.tcp://host:port/path")
    namespace_uri: str = Field(description="namespace that holds the variables")
    nodes: OpcUaNodesConfig = Field(default_factory=OpcUaNodesConfig, description="identifiers of the variables")
    security: OpcUaSecurityConfig | None = Field(
        None, description="Basic256Sha256, sign and encrypt, with a user; without it nothing is written"
    )
    allow_insecure_writes: bool = Field(
        False, description="write over an unencrypted or anonymous connection all the same (shown everywhere)"
    )


class MacroMapConfig(Section):
    """The block of macro variables that carries compensation to the CNC, and its echo."""

    writable: list[MacroRange] = Field(
        description="the only macro variables that may ever be written, as numbers or ranges"
    )
    sequence_a: MacroNumber = Field(description="written first; equal to sequence_b when the block is whole")
    sequence_b: MacroNumber = Field(description="written last")
    valid_until: MacroNumber = Field(
        description="CNC clock until which the block is valid [s]; must lie where power-off clears it (100-199)"
    )
    enable: MacroNumber = Field(description="one bit per axis, in the order of compensation.axes")
    values: dict[Name, MacroNumber] = Field(description="compensation per axis")
    echo_applied: dict[Name, MacroNumber] = Field(description="what the guard has applied, per axis")
    echo_time: MacroNumber = Field(description="CNC clock when the guard last ran [s]")
    echo_status: MacroNumber = Field(description="what the guard did: 0 applied, else its refusal")
    echo_guard_version: MacroNumber = Field(description="version of the guard macro")
    unit_um: float = Field(1000.0, gt=0, description="micrometres per unit of the value macros (1000: mm)")
    tolerance: float = Field(
        1e-6, ge=1e-8, description="largest difference between written and read back, in the macros' unit"
    )

    @model_validator(mode="after")
    def _allowed(self) -> "MacroMapConfig":
        allowed = self.allowed
        written = [self.sequence_a, self.sequence_b, self.valid_until, self.enable, *self.values.values()]
        echoed = [*self.echo_applied.values(), self.echo_time, self.echo_status, self.echo_guard_version]
        if outside := [number for number in written if number not in allowed]:
            raise ValueError(f"macro variables outside `writable`: {outside}")
        numbers = written + echoed
        if twice := sorted({n for n in numbers if numbers.count(n) > 1}):
            raise ValueError(f"macro variables used twice: {twice}")
        if set(self.values) != set(self.echo_applied):
            raise ValueError("values and echo_applied must name the same axes")
        if not 100 <= self.valid_until <= 199:
            raise ValueError("valid_until must be one of #100-#199, which power-off clears")
        return self

    @cached_property
    def allowed(self) -> frozenset[int]:
        """Numbers of all macro variables that may be written."""
        return frozenset(expand_ranges([entry if "-" in entry else f"{entry}-{entry}" for entry in self.writable]))

    @cached_property
    def block(self) -> tuple[int, ...]:
        """All macro variables that are polled: ours first, then the echo."""
        return (
            self.sequence_a,
            *self.values.values(),
            self.valid_until,
            self.enable,
            self.sequence_b,
            *self.echo_applied.values(),
            self.echo_time,
            self.echo_status,
            self.echo_guard_version,
        )


class CncConfig(Section):
    """The CNC."""

    driver: Literal["opcua"] = Field("opcua", description="protocol")
    opcua: OpcUaConfig = Field(description="OPC UA connection")
    poll_period_s: Seconds = Field(0.5, description="time between polls of the CNC's state")
    timeout_s: Seconds = Field(1.0, description="every call ends after this long [s of the wall clock]")
    stale_after_s: Seconds = Field(
        3.0, description="without an answer, or with its clock standing still, for this long the link is dead"
    )
    macros: MacroMapConfig = Field(description="macro variables")
