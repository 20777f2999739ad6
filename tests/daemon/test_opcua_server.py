"""The daemon as an OPC UA server: what is served, who may do what, and that nobody can change it."""

import asyncio
import contextlib
import math
from dataclasses import replace
from pathlib import Path

import pytest
from asyncua import Client, ua
from asyncua.common.utils import Buffer
from asyncua.crypto.security_policies import SecurityPolicyBasic256Sha256
from asyncua.crypto.uacrypto import CertProperties
from asyncua.ua.ua_binary import struct_from_binary
from asyncua.ua.uaerrors import UaError, UaStatusCodeError
from control_rig import SENSOR_IDS
from hypothesis import given, settings
from hypothesis import strategies as st
from opcua_bench import NOW, ROLES, TAGS, OpcUaBench, tag_server, tell
from scripted_machine import Keys
from structlog.testing import capture_logs

from daemon.history.reader import HistoryReader
from drivers.opcua.bounded import Received
from drivers.opcua.server import subscriptions
from drivers.opcua.server.encoding import Kind, variant
from drivers.opcua.server.requests import Request, ServiceError
from drivers.opcua.server.session import Session
from drivers.opcua.server.space import Variable
from drivers.opcua.server.subscriptions import Item, Publisher, PublishRequest
from drivers.opcua.server.wire import WireError, _decoded

METHODS = {"reference": [], "enable": [[]], "disable": [[], False], "acknowledge": [1]}


@pytest.fixture(scope="module")
def keys(tmp_path_factory):
    return Keys(tmp_path_factory.mktemp("keys"))


async def index(client: Client) -> int:
    return int(await client.get_namespace_index(TAGS))


async def node(client: Client, name: str):
    return client.get_node(ua.NodeId(name, await index(client)))


async def test_every_sensor_is_a_tag_with_quality_source_time_and_where_it_sits(tmp_path, keys):
    async with tag_server(tmp_path, keys) as bench, bench.logged_in("otto") as client:
        before = await (await node(client, "temperature.1")).read_data_value(raise_on_bad_status=False)
        assert before.StatusCode.name == "BadWaitingForInitialData" and before.Value.Value is None
        bench.rig.snapshots.control = replace(bench.rig.snapshots.control, cnc=None)
        state = await (await node(client, "state.output")).read_data_value()
        assert before.SourceTimestamp is state.SourceTimestamp is None, "a historian would put it into the year 1970"
        tell(bench)
        found = {}
        for sensor in SENSOR_IDS:
            value = await (await node(client, f"temperature.{sensor}")).read_data_value(raise_on_bad_status=False)
            found[sensor] = (value.Value.Value, value.StatusCode.name)
        assert found == {
            1: (21.5, "Good"),
            2: (22.0, "UncertainLastUsableValue"),
            3: (None, "BadOutOfRange"),
            11: (None, "BadNoCommunication"),
            12: (20.0, "Good"),
        }
        held = await (await node(client, "temperature.2")).read_data_value(raise_on_bad_status=False)
        assert held.SourceTimestamp.timestamp() == pytest.approx(NOW.utc_s - 12.0)
        tag = await node(client, "temperature.1")
        facts = {(await each.read_browse_name()).Name: await each.read_value() for each in await tag.get_properties()}
        sensor = bench.configuration.temperatures.sensors[0]
        assert facts.pop("EngineeringUnits").DisplayName.Text == "°C"
        assert facts == {"Component": sensor.component, "Part": sensor.part, "Label": sensor.label or ""}


async def test_estimate_compensation_and_state_are_tags_and_a_subscriber_hears_of_changes(tmp_path, keys):
    class Heard:
        def __init__(self):
            self.values = asyncio.Queue()

        def datachange_notification(self, node, value, data):
            self.values.put_nowait((node.nodeid.Identifier, value))

    async with tag_server(tmp_path, keys) as bench:
        rig = bench.rig
        await rig.active()
        await rig.follow(3.0, -8.0, turns=4)
        async with bench.logged_in("otto") as client:
            values = {}
            for name in ("state.output", "state.phase", "compensation.z.estimated_um", "compensation.z.applied_um"):
                values[name] = await (await node(client, name)).read_value()
            assert values["state.output"] == "ACTIVE" == rig.state
            assert values["compensation.z.estimated_um"] == -8.0
            assert values["compensation.z.applied_um"] == rig.snapshots.control.applied_um[2] > 0.0
            heard = Heard()
            subscription = await client.create_subscription(250, heard)
            watched = [await node(client, name) for name in ("temperature.1", "temperature.12", "state.output")]
            await subscription.subscribe_data_change(watched)
            first = {(await asyncio.wait_for(heard.values.get(), 20.0))[0] for _ in watched}
            assert first == {"temperature.1", "temperature.12", "state.output"}
            tell(bench)
            assert [await asyncio.wait_for(heard.values.get(), 20.0) for _ in range(2)] == [
                ("temperature.1", 21.5),
                ("temperature.12", 20.0),
            ]
            tell(bench, first_degc=21.75)
            assert await asyncio.wait_for(heard.values.get(), 20.0) == ("temperature.1", 21.75)
            tell(bench, first_degc=21.75, utc_s=NOW.utc_s + 10.0)
            tell(bench, first_degc=22.0)
            news = await asyncio.wait_for(heard.values.get(), 20.0)
            assert news == ("temperature.1", 22.0), "a new time alone is no change"
            await subscription.delete()


async def test_a_subscriber_hears_the_clock_go_on(tmp_path, keys):
    """Plant systems take a server whose CurrentTime stands still for one that hangs."""
    heard: dict[int, list[object]] = {2258: [], 2256: []}

    class Heard:
        def datachange_notification(self, node, value, data):
            heard[node.nodeid.Identifier].append(value)

    async with tag_server(tmp_path, keys) as bench, bench.logged_in("otto") as client:
        subscription = await client.create_subscription(250, Heard())
        await subscription.subscribe_data_change([client.get_node(f"i={number}") for number in heard])
        async with asyncio.timeout(20.0):
            while min(map(len, heard.values())) < 3:
                await asyncio.sleep(0.05)
        await subscription.delete()
    assert heard[2258] == sorted(set(heard[2258])) and heard[2256][0].CurrentTime < heard[2256][-1].CurrentTime


async def moved(bench: OpcUaBench, what):
    """Move the output on until a call has been answered."""
    asked = asyncio.ensure_future(what)
    while not asked.done():
        await bench.rig.turn()
        await asyncio.sleep(0.01)
    return asked.result()


async def call(client: Client, name: str, values: list):
    machine = await node(client, "machine")
    types = [
        ua.Variant(value, ua.VariantType.String, is_array=True) if isinstance(value, list) else ua.Variant(value)
        for value in values
    ]
    return await machine.call_method(ua.NodeId(name, await index(client)), *types)


async def test_methods_take_the_operators_right_and_name_the_person_in_the_audit(tmp_path, keys):
    async with tag_server(tmp_path, keys) as bench:
        rig = bench.rig
        await rig.turn()
        rig.set_reference()
        await rig.turn()
        async with bench.logged_in("otto") as viewer:
            for name, values in METHODS.items():
                with pytest.raises(UaError, match="BadUserAccessDenied"):
                    await call(viewer, name, values)
            assert not any(rig.control.memory.wanted)
            refused = await (await node(viewer, "state.last_refusal")).read_value()
            assert refused == "acknowledge: otto is viewer; this takes the role operator"
            may = await (await node(viewer, "enable")).read_attribute(ua.AttributeIds.UserExecutable)
            assert may.Value.Value is False
        async with bench.logged_in("anna") as operator:
            decided, state, _ = await moved(bench, call(operator, "enable", [["y", "z"]]))
            assert decided and state == "ARMED"
            assert [axis for axis, on in zip("xyz", rig.control.memory.wanted, strict=True) if on] == ["y", "z"]
            with pytest.raises(UaError, match="BadInvalidState"):
                await moved(bench, call(operator, "enable", [["w"]]))
            assert "no axis w" in await (await node(operator, "state.last_refusal")).read_value()
            with pytest.raises(UaError, match="BadInvalidArgument"):
                await call(operator, "disable", [[], "yes"])
            with pytest.raises(UaError, match="BadArgumentsMissing"):
                await call(operator, "disable", [[]])
            absent = ua.CallMethodRequest(
                (await node(operator, "machine")).nodeid, (await node(operator, "acknowledge")).nodeid
            )
            absent.InputArguments = None
            (answered,) = await moved(bench, operator.uaclient.call([absent]))
            assert answered.StatusCode.name == "BadArgumentsMissing", "no list of arguments is an empty one"
            assert (await moved(bench, call(operator, "disable", [[], True])))[0] is True
            assert not any(rig.control.memory.wanted)
        await rig.history.flushed()
        access = bench.events()
        assert ("logged in over OPC UA", "anna (operator, OPC UA, 127.0.0.1)") in access
        assert ("logged out over OPC UA", "otto (viewer, OPC UA, 127.0.0.1)") in access
        refusal = "refused: OPC UA method enable takes the role operator"
        assert (refusal, "otto (viewer, OPC UA, 127.0.0.1)") in access
        with HistoryReader(bench.configuration.history.path) as reader:
            people = {each.person for each in reader.events(0.0, 1e11) if each.kind != "access"}
        assert "anna (operator, OPC UA, 127.0.0.1)" in people
        assert not any(person and "otto" in person for person in people)


@pytest.mark.parametrize("name", ROLES)
async def test_nobody_changes_the_server_whatever_their_role(tmp_path, keys, name):
    async with tag_server(tmp_path, keys) as bench:
        tell(bench)
        async with bench.logged_in(name) as client:
            for tag in ("temperature.1", "state.output", "compensation.z.applied_um", "temperature.1.Component"):
                target = await node(client, tag)
                old = await target.read_data_value(raise_on_bad_status=False)
                with pytest.raises(UaStatusCodeError, match="BadNotWritable"):
                    await target.write_value(old.Value.Value if old.Value.Value is not None else 1.0)
                for attribute in (
                    ua.AttributeIds.AccessLevel,
                    ua.AttributeIds.DisplayName,
                    ua.AttributeIds.UserAccessLevel,
                ):
                    with pytest.raises(UaStatusCodeError, match="BadNotWritable"):
                        await target.write_attribute(attribute, ua.DataValue(ua.Variant(255, ua.VariantType.Byte)))
                with pytest.raises(UaStatusCodeError, match="BadServiceUnsupported"):
                    await client.delete_nodes([target])
                level = await target.read_attribute(ua.AttributeIds.UserAccessLevel)
                assert level.Value.Value == 1, "it can be read, and that is all"
            with pytest.raises(UaStatusCodeError, match="BadServiceUnsupported"):
                await (await node(client, "machine")).add_variable(await index(client), "mine", 1.0)
            with pytest.raises(UaStatusCodeError, match="BadServiceUnsupported"):
                reference = ua.DeleteReferencesItem(SourceNodeId=ua.NodeId(85), TargetNodeId=ua.NodeId(2253))
                await client.uaclient.delete_references([reference])
            with pytest.raises(UaStatusCodeError, match="BadServiceUnsupported"):
                await (await node(client, "temperature.1")).read_raw_history()
            assert (await (await node(client, "temperature.1")).read_value()) == 21.5


async def test_who_is_not_named_not_trusted_or_not_signed_does_not_get_in(tmp_path, keys, tmp_path_factory):
    strangers = Keys(tmp_path_factory.mktemp("strangers"))
    async with tag_server(tmp_path, keys) as bench:
        with pytest.raises(UaStatusCodeError, match="BadIdentityTokenRejected"):
            await (await bench.client()).connect()
        stranger = await bench.client("anna", keys=strangers)
        with pytest.raises((UaError, ConnectionError, TimeoutError)):
            await stranger.connect()
        plain = Client(bench.url, timeout=20.0)
        plain.set_user("anna")
        plain.set_password("long enough a password")
        with pytest.raises(UaError):
            await plain.connect()
        offered = await Client(bench.url, timeout=20.0).connect_and_get_server_endpoints()
        assert {(each.SecurityPolicyUri.rpartition("#")[2], each.SecurityMode.name) for each in offered} == {
            ("Basic256Sha256", "Sign"),
            ("Basic256Sha256", "SignAndEncrypt"),
        }
        assert {token.TokenType.name for each in offered for token in each.UserIdentityTokens} == {"UserName"}
        async with bench.logged_in("otto", mode=ua.MessageSecurityMode.Sign) as signed:
            assert await (await node(signed, "state.output")).read_value() == "OFF"
        for _ in range(5):
            with pytest.raises(UaStatusCodeError, match="BadUserAccessDenied"):
                await (await bench.client("anna", password="not the password")).connect()
        with pytest.raises(UaStatusCodeError, match="BadUserAccessDenied"):
            await (await bench.client("anna")).connect()
        await bench.rig.history.flushed()
        assert bench.events().count(("wrong name or password over OPC UA ('anna')", "127.0.0.1")) == 5
        assert not any(person and "anna" in person for _, person in bench.events())


async def test_a_renewed_certificate_counts_from_the_next_connection_and_waits_for_its_key(tmp_path):
    for name in ("keys", "renewed"):
        (tmp_path / name).mkdir()
    keys, renewed = Keys(tmp_path / "keys"), Keys(tmp_path / "renewed")
    before = tmp_path / "before.pem"
    before.write_bytes(keys.server.read_bytes())

    async def reads(bench: OpcUaBench, trusting: Path) -> bool:
        client = await bench.client("otto")
        await client.set_security(
            SecurityPolicyBasic256Sha256,
            str(keys.client),
            CertProperties(keys.client_key, extension="pem"),
            server_certificate=str(trusting),
        )
        client.session_timeout = 60_000
        try:
            async with asyncio.timeout(10.0), client:
                return await (await node(client, "state.output")).read_value() == "OFF"
        except (UaError, ConnectionError, TimeoutError):
            return False

    async with tag_server(tmp_path, keys) as bench:
        assert await reads(bench, before)
        keys.server.write_bytes(renewed.server.read_bytes())
        with capture_logs() as logs:
            assert await reads(bench, before), "its key is not there yet"
        assert any("does not belong to the certificate" in entry.get("problem", "") for entry in logs)
        keys.server_key.write_bytes(renewed.server_key.read_bytes())
        assert await reads(bench, keys.server)
        assert not await reads(bench, before)


async def test_a_client_may_send_its_certificate_with_those_of_its_authorities(tmp_path, keys):
    async with tag_server(tmp_path, keys) as bench:
        client = await bench.client("otto")
        policy, create = client.security_policy, client.uaclient.create_session
        policy.host_certificate_chain = [Path(keys.server).read_bytes()]

        def with_chain(asked):
            asked.ClientCertificate += policy.host_certificate_chain[0]
            return create(asked)

        client.uaclient.create_session = with_chain
        async with client:
            assert TAGS in await client.get_namespace_array()


async def test_a_session_ends_with_its_account_and_there_are_only_so_many(tmp_path, keys):
    async with (
        tag_server(tmp_path, keys, sessions=2) as bench,
        bench.logged_in("otto") as one,
        bench.logged_in("anna") as other,
    ):
        with pytest.raises(UaStatusCodeError, match="BadTooManySessions"):
            await (await bench.client("eva")).connect()
        users = bench.configuration.service.users
        kept = [line for line in users.read_text().splitlines() if not line.startswith("anna")]
        users.write_text("\n".join(kept) + "\n")
        with pytest.raises(UaStatusCodeError, match="BadSessionClosed"):
            await (await node(other, "state.output")).read_value()
        assert await (await node(one, "state.output")).read_value() == "OFF"


async def test_who_asks_with_half_an_address_is_answered(tmp_path, keys):
    async with tag_server(tmp_path, keys) as bench, bench.logged_in("otto") as client:
        (first, *_) = await client.uaclient.get_endpoints(ua.GetEndpointsParameters(EndpointUrl="opc.tcp://[::1"))
        assert first.EndpointUrl == "opc.tcp://localhost/"


async def test_requests_of_a_stranger_that_arrive_together_leave_the_control_its_turn(tmp_path, keys, monkeypatch):
    answered, endpoints, most = [0], Session.endpoints, 0

    def counted(*arguments):
        answered[0] += 1
        return endpoints(*arguments)

    monkeypatch.setattr(Session, "endpoints", counted)
    async with tag_server(tmp_path, keys) as bench, asyncio.timeout(60):
        client = Client(bench.url)
        await client.connect_socket()
        await client.send_hello()
        await client.open_secure_channel()
        asking = [asyncio.ensure_future(client.uaclient.get_endpoints(ua.GetEndpointsParameters())) for _ in range(100)]
        while answered[0] < len(asking):
            before = answered[0]
            await asyncio.sleep(0)
            most = max(most, answered[0] - before)
        assert most <= 2
        await asyncio.gather(*asking)
        client.disconnect_socket()


async def test_a_client_that_takes_nothing_gets_the_newest_and_holds_up_nobody():
    sent, room = [], [math.inf]
    publisher = Publisher(lambda body, number: sent.append((number, body)), lambda: room[0])
    made = publisher.create((250.0, 30, 10, 0, True))
    tag = Variable((2, "x"), "x", Kind.DOUBLE)
    made.items[1] = Item(variable=tag, handle=bytes(4), stamps=3, trigger=1, mode=2)

    def ask(number):
        publisher.wait(PublishRequest(number=number, handle=number, acknowledged=bytes(4), until_s=math.inf))

    def tell_value(value):
        tag.set(variant(Kind.DOUBLE, value), 0, 1.0)

    tell_value(1.0)
    ask(1)
    publisher.due(made.due_s)
    assert [number for number, _ in sent] == [1] and variant(Kind.DOUBLE, 1.0) in sent[0][1]
    room[0] = 0.0
    for number in range(2, 30):
        ask(number)
        tell_value(float(number))
        publisher.due(made.due_s)
    told = [body for _, body in sent[1:]]
    assert all(body.startswith(b"\x01\x00\x8d\x01") for body in told), "only refusals of waiting requests"
    assert len(told) == 28 - subscriptions.MOST_PUBLISH_REQUESTS and len(publisher._requests) <= 12
    room[0] = math.inf
    ask(30)
    newest = [body for _, body in sent if variant(Kind.DOUBLE, 29.0) in body]
    assert len(newest) == 1, "of all that was missed the newest alone"
    assert not any(variant(Kind.DOUBLE, 28.0) in body for _, body in sent)
    assert len(made.kept) <= subscriptions.MOST_KEPT


async def test_no_answer_is_longer_than_the_client_takes(tmp_path, keys):
    async with tag_server(tmp_path, keys) as bench:
        for most_bytes, most_chunks, of_session, count in ((6000, 0, 0, 300), (0, 1, 0, 1900), (0, 0, 6000, 300)):
            client = await bench.client("otto")
            create = client.uaclient.create_session

            def limited(asked, most=of_session, create=create):
                asked.MaxResponseMessageSize = ua.UInt32(most)
                return create(asked)

            client.uaclient.create_session = limited
            client.max_messagesize, client.max_chunkcount = most_bytes, most_chunks
            async with client:
                names = client.get_node(ua.ObjectIds.Server_NamespaceArray)
                with pytest.raises(UaStatusCodeError, match="BadResponseTooLarge"):
                    await client.read_values([names] * count)
                assert len(await client.read_values([names] * 20)) == 20


async def test_of_many_changes_a_client_is_told_as_many_at_a_time_as_it_takes():
    sent = []
    publisher = Publisher(lambda body, number: sent.append(body), lambda: 600.0)
    made = publisher.create((250.0, 30, 10, 0, True))
    for number in range(100):
        tag = Variable((2, str(number)), "x", Kind.DOUBLE)
        tag.set(variant(Kind.DOUBLE, float(number)), 0, 1.0)
        made.items[number] = Item(variable=tag, handle=bytes(4), stamps=3, trigger=1, mode=2)
    for number in range(12):
        publisher.wait(PublishRequest(number=number, handle=number, acknowledged=bytes(4), until_s=math.inf))
    publisher.due(made.due_s)
    told = b"".join(sent)
    assert max(map(len, sent)) <= 600
    assert all(told.count(variant(Kind.DOUBLE, float(number))) == 1 for number in range(100))


NO_HEADER = bytes(2) + bytes(8) + (9).to_bytes(4, "little") + bytes(4) + b"\xff" * 4 + bytes(4)
ENDLESS = (2_000_000).to_bytes(4, "little")


def test_decoding_ends_with_the_bytes_whatever_lengths_they_name():
    literal = b"\x01\x00\x55\x02\x01" + (5).to_bytes(4, "little") + b"\x80" + ENDLESS
    request = Request(1, Buffer(b"\x01\x00\xac\x01" + NO_HEADER + literal + b"rest"))
    assert (request.service, request.handle) == (428, 9)
    assert request.body.read(4) == b"rest", "an additional header is passed over, and not decoded"
    back = b"\xff" * 4 + ENDLESS + b"\xfc\xff\xff\xff"
    request = Request(1, Buffer(b"\x01\x00\xac\x01" + NO_HEADER + bytes(3) + back))
    with pytest.raises(ServiceError):
        request.structure(ua.GetEndpointsParameters)
    call = bytes(4) + (1).to_bytes(4, "little") + b"\x80" + ENDLESS
    request = Request(1, Buffer(b"\x01\x00\xc8\x02" + NO_HEADER + bytes(3) + call))
    with pytest.raises(ServiceError):
        request.structure(ua.CallMethodRequest)
    with pytest.raises(WireError):
        _decoded(lambda: struct_from_binary(ua.RequestHeader, Received(NO_HEADER + literal)))


@settings(max_examples=100, deadline=None)
@given(st.binary(max_size=200))
def test_a_request_of_any_bytes_is_refused_in_order(body):
    with contextlib.suppress(ServiceError):
        request = Request(1, Buffer(body))
        with contextlib.suppress(ServiceError):
            request.structure(ua.CreateSessionParameters)


async def test_what_is_no_opc_ua_is_told_so_and_cut_off(tmp_path, keys):
    async with tag_server(tmp_path, keys) as bench:
        port = bench.configuration.opcua_server.port
        for sent, status in (
            (b"GET / HTTP/1.1\r\nHost: x\r\n\r\n", "BadTcpMessageTooLarge"),
            (b"OPNF" + (32).to_bytes(4, "little") + bytes(24), "BadConnectionRejected"),
            (b"MSGF" + (32).to_bytes(4, "little") + bytes(24), "BadSecureChannelClosed"),
            (b"HELF" + (32).to_bytes(4, "little") + bytes(24), "BadConnectionRejected"),
        ):
            reader, writer = await asyncio.open_connection("127.0.0.1", port)
            writer.write(sent)
            answer = await asyncio.wait_for(reader.read(), 20.0)
            assert answer[:4] == b"ERRF" and int.from_bytes(answer[8:12], "little") == getattr(ua.StatusCodes, status)
            writer.close()
        async with bench.logged_in("otto") as client:
            assert await (await node(client, "state.output")).read_value() == "OFF"
