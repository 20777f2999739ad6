"""The requests about subscriptions and the tags that they watch (OPC 10000-4, 5.12 and 5.13)."""

import struct
import time
from collections.abc import Callable
from typing import Any

from asyncua import ua
from asyncua.ua.status_codes import StatusCodes

from drivers.opcua.server.requests import Request, ServiceError, key_of, listed, results, status_bytes
from drivers.opcua.server.space import Space, Variable
from drivers.opcua.server.subscriptions import MOST_ITEMS, TRIGGER_VALUE, Item, Publisher, PublishRequest, Subscription
from drivers.opcua.server.views import VALUE

NO_FILTER_RESULT = b"\x00\x00\x00"
QUEUE = 1
FOREVER_S = 3600.0
MOST_ACKNOWLEDGED = 100


class Watching:
    """Creates, changes and ends the subscriptions of one session."""

    def __init__(self, space: Space, publisher: Publisher, wake: Callable[[], None]) -> None:
        """`wake` is called when something may be due earlier than before."""
        self._space, self._publisher, self._wake = space, publisher, wake

    async def create(self, request: Request) -> bytes:
        """Answer CreateSubscription."""
        interval_ms, lifetime, most_silent, most, publishing, _ = request.unpacked("<dIII?B")
        made = self._publisher.create((interval_ms, lifetime, most_silent, most, publishing))
        if made is None:
            raise ServiceError(StatusCodes.BadTooManySubscriptions)
        self._wake()
        return status_bytes(made.number) + made.revised()

    async def modify(self, request: Request) -> bytes:
        """Answer ModifySubscription."""
        number, interval_ms, lifetime, most_silent, most, _ = request.unpacked("<IdIIIB")
        subscription = self._known(number)
        subscription.revise(interval_ms, most_silent, lifetime, most)
        self._wake()
        return subscription.revised()

    async def set_publishing(self, request: Request) -> bytes:
        """Answer SetPublishingMode."""
        (publishing,) = request.unpacked("<?")
        statuses = []
        async for number in request.numbers():
            subscription = self._publisher.subscriptions.get(number)
            if subscription is not None:
                subscription.publishing = publishing
            missing = subscription is None
            statuses.append(status_bytes(StatusCodes.BadSubscriptionIdInvalid if missing else StatusCodes.Good))
        return results(statuses)

    async def delete(self, request: Request) -> bytes:
        """Answer DeleteSubscriptions."""
        return results([status_bytes(self._publisher.delete(number)) async for number in request.numbers()])

    async def publish(self, request: Request) -> None:
        """Take a Publish request: it is answered when there is something to tell."""
        statuses = []
        (count,) = request.unpacked("<i")
        if count > MOST_ACKNOWLEDGED:
            raise ServiceError(StatusCodes.BadTooManyOperations)
        for _ in range(count):
            statuses.append(status_bytes(self._publisher.acknowledge(*request.unpacked("<II"))))
        waits = PublishRequest(
            number=request.number,
            handle=request.handle,
            acknowledged=listed(statuses),
            until_s=time.monotonic() + (request.timeout_s or FOREVER_S),
        )
        self._publisher.wait(waits)

    async def republish(self, request: Request) -> bytes:
        number, sequence = request.unpacked("<II")
        found = self._known(number).kept.get(sequence)
        if found is None:
            raise ServiceError(StatusCodes.BadMessageNotAvailable)
        return found

    async def watch(self, request: Request) -> bytes:
        """Answer CreateMonitoredItems."""
        number, stamps = request.unpacked("<Ii")
        subscription = self._known(number)
        if stamps not in range(4):
            raise ServiceError(StatusCodes.BadTimestampsToReturnInvalid)
        kind = ua.MonitoredItemCreateRequest
        return results([self._watched(subscription, stamps, each) async for each in request.each(kind)])

    def _watched(self, subscription: Subscription, stamps: int, wanted: Any) -> bytes:
        target, parameters = wanted.ItemToMonitor, wanted.RequestedParameters
        node = self._space.nodes.get(key_of(target.NodeId))
        trigger, status = _trigger(parameters.Filter)
        if node is None:
            status = StatusCodes.BadNodeIdUnknown
        elif target.AttributeId != VALUE or not isinstance(node, Variable):
            status = StatusCodes.BadAttributeIdInvalid
        elif target.IndexRange:
            status = StatusCodes.BadIndexRangeInvalid
        elif len(subscription.items) >= MOST_ITEMS:
            status = StatusCodes.BadTooManyMonitoredItems
        if status or not isinstance(node, Variable):
            return struct.pack("<IIdI", status, 0, 0.0, 0) + NO_FILTER_RESULT
        item = Item(
            variable=node,
            handle=status_bytes(parameters.ClientHandle),
            stamps=stamps,
            trigger=trigger,
            mode=int(wanted.MonitoringMode),
        )
        number = subscription.next_item
        subscription.next_item += 1
        subscription.items[number] = item
        return struct.pack("<IIdI", 0, number, subscription.interval_s * 1e3, QUEUE) + NO_FILTER_RESULT

    async def modify_items(self, request: Request) -> bytes:
        """Answer ModifyMonitoredItems."""
        number, stamps = request.unpacked("<Ii")
        subscription = self._known(number)
        entries = []
        async for wanted in request.each(ua.MonitoredItemModifyRequest):
            item = subscription.items.get(wanted.MonitoredItemId)
            trigger, status = _trigger(wanted.RequestedParameters.Filter)
            if item is None:
                status = StatusCodes.BadMonitoredItemIdInvalid
            elif not status:
                item.handle = status_bytes(wanted.RequestedParameters.ClientHandle)
                item.stamps, item.trigger = stamps if stamps in range(4) else item.stamps, trigger
            entries.append(struct.pack("<IdI", status, subscription.interval_s * 1e3, QUEUE) + NO_FILTER_RESULT)
        return results(entries)

    async def set_mode(self, request: Request) -> bytes:
        """Answer SetMonitoringMode."""
        number, mode = request.unpacked("<Ii")
        items = self._known(number).items
        if mode not in range(3):
            raise ServiceError(StatusCodes.BadMonitoringModeInvalid)
        statuses = []
        async for each in request.numbers():
            if (item := items.get(each)) is not None:
                item.mode = mode
            statuses.append(status_bytes(StatusCodes.BadMonitoredItemIdInvalid if item is None else StatusCodes.Good))
        return results(statuses)

    async def unwatch(self, request: Request) -> bytes:
        """Answer DeleteMonitoredItems."""
        (number,) = request.unpacked("<I")
        items = self._known(number).items
        gone = [items.pop(each, None) async for each in request.numbers()]
        bad, good = StatusCodes.BadMonitoredItemIdInvalid, StatusCodes.Good
        return results([status_bytes(bad if item is None else good) for item in gone])

    def _known(self, number: int) -> Subscription:
        subscription = self._publisher.subscriptions.get(number)
        if subscription is None:
            raise ServiceError(StatusCodes.BadSubscriptionIdInvalid)
        return subscription


def _trigger(wanted: Any) -> tuple[int, int]:
    """Return what an item tells, and the status of its filter: bands and events are not served."""
    if (
        type(wanted).__name__ == "DataChangeFilter"
    ):  # the library has two classes of this name, and decodes to the other
        if wanted.DeadbandType:
            return TRIGGER_VALUE, int(StatusCodes.BadMonitoredItemFilterUnsupported)
        return int(wanted.Trigger), int(StatusCodes.Good)
    if wanted is None or (isinstance(wanted, ua.ExtensionObject) and wanted.TypeId == ua.NodeId()):
        return TRIGGER_VALUE, int(StatusCodes.Good)
    return TRIGGER_VALUE, int(StatusCodes.BadMonitoredItemFilterUnsupported)
