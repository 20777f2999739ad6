"""Encoding the block, decoding the echo, and telling ours from foreign."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from config.schema.cnc import MacroMapConfig
from daemon.cnc.macro_block import MacroBlock
from models.records import CompensationCommand, OutputState

AXES = ("y", "z")


def macro_map(**changes):
    content = {
        "writable": ["120", "500-510"],
        "sequence_a": 500,
        "values": {"y": 501, "z": 502},
        "valid_until": 120,
        "enable": 503,
        "sequence_b": 504,
        "check": 505,
        "echo_applied": {"y": 511, "z": 512},
        "echo_time": 514,
        "echo_status": 515,
        "echo_guard_version": 516,
    }
    return MacroMapConfig(**{**content, **changes})


def command(um, enable=(True, True)):
    return CompensationCommand(
        axes=AXES,
        requested_um=np.array(um),
        compensation_um=np.array(um),
        enable=enable,
        state=OutputState.ACTIVE,
        reason="",
        write=True,
    )


def test_the_block_goes_out_first_to_last_in_millimetres():
    groups = MacroBlock(macro_map(), AXES, {}).encode(command([3.0, -12.5]), sequence=7, valid_until_s=100.0)
    assert groups == (
        ((500, 7.0),),
        ((501, 0.003), (502, -0.0125), (120, 100.0), (503, 3.0), (505, 7 + 1000 + 3 + 3000 - 2 * 12500)),
        ((504, 7.0),),
    )


def test_a_commissioned_sign_turns_the_written_value_and_the_echo_alike():
    block = MacroBlock(macro_map(), AXES, {"z": -1.0})
    written = dict(block.encode(command([0.0, 12.5]), sequence=1, valid_until_s=0.0)[1])
    assert written[502] == pytest.approx(-0.0125)
    echo = block.echo({511: 0.0, 512: -0.0125, 514: 9.0, 515: 0.0, 516: 1.0})
    assert echo.applied_um == pytest.approx([0.0, 12.5])


@given(um=st.tuples(st.floats(-1000, 1000), st.floats(-1000, 1000)))
def test_what_is_encoded_is_decoded(um):
    block = MacroBlock(macro_map(), AXES, {"y": -1.0})
    content = dict(block.encode(command(um), sequence=1, valid_until_s=1.0)[1])
    echo = block.echo({511: content[501], 512: content[502]})
    half_a_step_um = 0.5e-3
    assert echo.applied_um == pytest.approx(np.array(um), abs=1.01 * half_a_step_um)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"enable": 999}, "outside `writable`"),
        ({"sequence_b": 500}, "used twice"),
        ({"valid_until": 505}, "#100-#199"),
        ({"echo_applied": {"y": 511}}, "same axes"),
    ],
)
def test_a_map_that_could_hurt_is_refused(change, words):
    with pytest.raises(ValidationError, match=words):
        macro_map(**change)
