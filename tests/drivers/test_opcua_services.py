"""The bodies of Read and Write that the driver puts together and takes apart, against the library's own."""

import struct

import pytest
from asyncua import ua
from asyncua.common.utils import Buffer
from asyncua.ua.ua_binary import struct_from_binary, struct_to_binary
from asyncua.ua.uaerrors import UaError, UaStatusCodeError

from drivers.opcua.services import (
    EPOCH_100NS,
    NO_ADDITION,
    READ_REQUEST,
    REQUEST_HEADER,
    WRITE_REQUEST,
    Answer,
    decode_read,
    decode_write,
    encode_number,
    encode_read,
    encode_target,
    encode_write,
)

NODES = [
    ua.NodeId("Macro500", 2),
    ua.NodeId(17, 0, ua.NodeIdType.TwoByte),
    ua.NodeId(4711, 3),
    ua.NodeId(1_000_000, 4),
]
BAD = ua.StatusCode(ua.UInt32(0x80B10000))
VALUES = [
    ua.DataValue(ua.Variant(0.1, ua.VariantType.Double), StatusCode=None),
    ua.DataValue(ua.Variant(-7, ua.VariantType.Int32)),
    ua.DataValue(ua.Variant(True, ua.VariantType.Boolean), StatusCode=None),
    ua.DataValue(ua.Variant(2**63, ua.VariantType.UInt64), StatusCode=None),
    ua.DataValue(ua.Variant(0.5, ua.VariantType.Float), StatusCode=None),
    ua.DataValue(StatusCode=BAD),
    ua.DataValue(ua.Variant(1.0, ua.VariantType.Double), StatusCode=BAD),
    ua.DataValue(StatusCode=None),
]
LIBRARYS = [
    ua.DataValue(ua.Variant("x", ua.VariantType.String), StatusCode=None),
    ua.DataValue(ua.Variant([1.0, 2.0], ua.VariantType.Double), StatusCode=None),
    ua.DataValue(ua.Variant(1.0, ua.VariantType.Double), SourceTimestamp=ua.DateTime(2026, 1, 1)),
]
"""What is left to the library's decoder."""


def read_response(values: list[ua.DataValue], **header: object) -> bytes:
    response = ua.ReadResponse()
    response.Results = list(values)
    for key, value in header.items():
        setattr(response.ResponseHeader, key, value)
    return bytes(struct_to_binary(response))


def write_response(statuses: list[ua.StatusCode]) -> bytes:
    response = ua.WriteResponse()
    response.Results = list(statuses)
    return bytes(struct_to_binary(response))


def whole(type_id: bytes, parameters: bytes) -> Buffer:
    """Return a request as the driver sends it, with no token of a session."""
    return Buffer(type_id + bytes(2) + REQUEST_HEADER.pack(EPOCH_100NS, 9, 0, -1, 3000, NO_ADDITION) + parameters)


def test_a_read_is_what_the_library_would_send() -> None:
    request = struct_from_binary(ua.ReadRequest, whole(READ_REQUEST, encode_read(NODES)))
    assert request.TypeId == ua.ReadRequest().TypeId
    assert (request.RequestHeader.RequestHandle, request.RequestHeader.TimeoutHint) == (9, 3000)
    assert [item.NodeId for item in request.Parameters.NodesToRead] == NODES
    assert {item.AttributeId for item in request.Parameters.NodesToRead} == {ua.AttributeIds.Value}
    assert request.Parameters.TimestampsToReturn == ua.TimestampsToReturn.Neither
    expected = ua.ReadRequest(Parameters=request.Parameters)
    expected.RequestHeader = request.RequestHeader
    assert struct_to_binary(expected) == bytes(whole(READ_REQUEST, encode_read(NODES)))


def test_a_write_is_what_the_library_would_send() -> None:
    values = [0.0, -0.0105, 1e9, 29_813.0]
    parameters = encode_write(
        [(encode_target(node), encode_number(value)[0]) for node, value in zip(NODES, values, strict=True)]
    )
    items = [
        ua.WriteValue(
            NodeId=node,
            AttributeId=ua.AttributeIds.Value,
            Value=ua.DataValue(ua.Variant(value, ua.VariantType.Double), StatusCode=None),
        )
        for node, value in zip(NODES, values, strict=True)
    ]
    assert parameters == struct_to_binary(ua.WriteParameters(NodesToWrite=items))
    request = struct_from_binary(ua.WriteRequest, whole(WRITE_REQUEST, parameters))
    assert request.TypeId == ua.WriteRequest().TypeId
    assert [item.Value.Value.Value for item in request.Parameters.NodesToWrite] == values


@pytest.mark.parametrize("values", [VALUES, [], *([value] for value in (*VALUES, *LIBRARYS)), [*VALUES, *LIBRARYS]])
def test_every_answer_is_read_as_the_library_reads_it(values: list[ua.DataValue]) -> None:
    body = read_response(values)
    expected = [
        Answer(
            0 if each.StatusCode is None else each.StatusCode.value, None if each.Value is None else each.Value.Value
        )
        for each in struct_from_binary(ua.ReadResponse, Buffer(body)).Results
    ]
    assert decode_read(body) == expected
    assert len(expected) == len(values)


def test_what_breaks_off_is_no_answer() -> None:
    body = read_response(VALUES)
    short = len(body) - 4  # without the number of diagnostics, which nobody reads
    for length in range(short):
        with pytest.raises(Exception, match=r".") as refused:
            decode_read(body[:length])
        assert not isinstance(refused.value, struct.error | IndexError), "the library says what is wrong"
    assert decode_read(body[:short]) == decode_read(body)


def test_statuses_of_a_write_and_one_that_breaks_off() -> None:
    body = write_response([ua.StatusCode(), BAD])
    assert decode_write(body) == [0, 0x80B10000]
    with pytest.raises(UaError):
        decode_write(body[:-8])


@pytest.mark.parametrize("decode", [decode_read, decode_write])
def test_a_refused_request_and_a_foreign_answer_are_refused(decode) -> None:
    fault = ua.ServiceFault()
    fault.ResponseHeader.ServiceResult = BAD
    with pytest.raises(UaStatusCodeError):
        decode(struct_to_binary(fault))
    with pytest.raises(UaError):
        decode(struct_to_binary(ua.BrowseResponse()))
    body = read_response(VALUES, ServiceResult=BAD) if decode is decode_read else write_response([])
    if decode is decode_read:
        with pytest.raises(UaStatusCodeError):
            decode(body)


def test_an_answer_with_texts_in_its_header_is_read_by_the_library() -> None:
    assert decode_read(read_response(VALUES[:2], StringTable=["a", "b"])) == [Answer(0, 0.1), Answer(0, -7)]
