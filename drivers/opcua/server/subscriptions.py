"""Subscriptions of one session (OPC 10000-4, 5.12 and 5.13): newest values, each encoded once for all, none queued."""

import struct
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from asyncua.ua.status_codes import StatusCodes

from drivers.opcua.server.encoding import node_id, time_100ns
from drivers.opcua.server.requests import answer, fault, listed, status_bytes
from drivers.opcua.server.space import Variable
from drivers.opcua.server.standard import LEAST_INTERVAL_MS

LONGEST_INTERVAL_MS = 60_000.0
MOST_SILENT = 600
MOST_SUBSCRIPTIONS = 4
MOST_ITEMS = 4000
"""Of one subscription."""
MOST_PUBLISH_REQUESTS = 12
MOST_KEPT = 4
"""So many messages are kept until the client has acknowledged them."""
ROOM_BESIDE = 128
"""What an answer holds beside the news and what was acknowledged [byte]."""
PUBLISH_RESPONSE = 829
DATA_CHANGE = node_id((0, 811))
REPORTING = 2
TRIGGER_STATUS, TRIGGER_VALUE, TRIGGER_TIME = 0, 1, 2


@dataclass(slots=True, kw_only=True)
class Item:
    """A tag that a client watches."""

    variable: Variable
    handle: bytes
    stamps: int
    trigger: int
    mode: int
    seen: int = 0
    """Count of the variable's changes that was told last."""
    status: int = -1

    def news(self) -> bytes | None:
        """Return what is to be told, None where nothing has changed."""
        variable = self.variable
        count = variable.stamped if self.trigger == TRIGGER_TIME else variable.changed
        if (count == self.seen and not variable.runs) or self.mode != REPORTING:
            return None
        self.seen = count
        if self.trigger == TRIGGER_STATUS:
            if variable.status == self.status:
                return None
            self.status = variable.status
        return self.handle + variable.read(self.stamps)


@dataclass(slots=True, kw_only=True)
class Subscription:
    """What is sent at the end of each interval."""

    number: int
    interval_s: float
    most_silent: int
    lifetime: int
    most_notifications: int
    publishing: bool
    due_s: float
    items: dict[int, Item] = field(default_factory=dict)
    next_item: int = 1
    sequence: int = 1
    silent: int = 0
    """Intervals in which nothing was sent; at first so many that the first interval sends."""
    starved: int = 0
    """Intervals in which no request for an answer was there."""
    kept: dict[int, bytes] = field(default_factory=dict)
    waiting: deque[bytes] = field(default_factory=deque)
    """Gathered, and not sent yet, because the client takes only so many at a time."""

    def revise(self, interval_ms: float, most_silent: int, lifetime: int, most: int) -> None:
        """Take what the client wishes, within what is granted."""
        granted_ms = (
            min(max(interval_ms, LEAST_INTERVAL_MS), LONGEST_INTERVAL_MS) if interval_ms > 0 else LEAST_INTERVAL_MS
        )
        self.interval_s = granted_ms / 1000.0
        self.most_silent = min(max(most_silent, 1), MOST_SILENT)
        self.lifetime = min(max(lifetime, 3 * self.most_silent), 10 * MOST_SILENT)
        self.most_notifications = most

    def revised(self) -> bytes:
        return struct.pack("<dII", self.interval_s * 1000.0, self.lifetime, self.most_silent)

    def gathered(self, room: float) -> list[bytes]:
        """Return what is to be told now, at most as much as the client takes at a time; the rest waits.

        `room`: so many bytes there are for it.
        """
        self.waiting.extend(news for item in self.items.values() if (news := item.news()) is not None)
        while len(self.waiting) > MOST_ITEMS:
            self.waiting.popleft()
        told: list[bytes] = []
        most = self.most_notifications or MOST_ITEMS
        while self.waiting and len(told) < most and (not told or len(self.waiting[0]) <= room):
            room -= len(self.waiting[0])
            told.append(self.waiting.popleft())
        return told

    def keep(self, message: bytes) -> None:
        """Keep a message until it is acknowledged, and count on."""
        self.kept[self.sequence] = message
        while len(self.kept) > MOST_KEPT:
            del self.kept[next(iter(self.kept))]
        self.sequence = self.sequence % 0xFFFF_FFFF + 1


@dataclass(frozen=True, slots=True, kw_only=True)
class PublishRequest:
    """A client waits for an answer."""

    number: int
    handle: int
    acknowledged: bytes
    """Results of what it acknowledged, encoded."""
    until_s: float


class Publisher:
    """The subscriptions of one session, and the requests that wait for their answers."""

    def __init__(self, send: Callable[[bytes, int], None], room: Callable[[], float]) -> None:
        """`send` takes an answer and its number, `room` tells how long that may be: at 0 values wait, the newest."""
        self._send, self._room = send, room
        self.subscriptions: dict[int, Subscription] = {}
        self._requests: deque[PublishRequest] = deque()
        self._made = 0

    def create(self, form: tuple[float, int, int, int, bool]) -> Subscription | None:
        """Return a new subscription; None where there are enough."""
        if len(self.subscriptions) >= MOST_SUBSCRIPTIONS:
            return None
        interval_ms, lifetime, most_silent, most, publishing = form
        self._made += 1
        made = Subscription(
            number=self._made,
            interval_s=1.0,
            most_silent=1,
            lifetime=3,
            most_notifications=0,
            publishing=publishing,
            due_s=time.monotonic(),
        )
        made.revise(interval_ms, most_silent, lifetime, most)
        made.silent = made.most_silent
        self.subscriptions[made.number] = made
        return made

    def wait(self, request: PublishRequest) -> None:
        """Let a request wait for its answer; the oldest is refused where too many do."""
        if not self.subscriptions:
            self._send(fault(request.handle, StatusCodes.BadNoSubscription), request.number)
            return
        self._requests.append(request)
        if len(self._requests) > MOST_PUBLISH_REQUESTS:
            oldest = self._requests.popleft()
            self._send(fault(oldest.handle, StatusCodes.BadTooManyPublishRequests), oldest.number)
        now_s = time.monotonic()
        for each in self.subscriptions.values():
            if (each.starved or each.waiting) and self._publish(each, now_s):
                each.starved = 0

    def acknowledge(self, subscription: int, sequence: int) -> int:
        """Forget a message that the client has; return the status of this."""
        found = self.subscriptions.get(subscription)
        if found is None:
            return int(StatusCodes.BadSubscriptionIdInvalid)
        return int(StatusCodes.BadSequenceNumberUnknown if found.kept.pop(sequence, None) is None else StatusCodes.Good)

    def delete(self, number: int) -> int:
        """End a subscription; return the status of this. With the last one the waiting requests end."""
        gone = self.subscriptions.pop(number, None)
        if not self.subscriptions:
            self._refuse_all()
        return int(StatusCodes.BadSubscriptionIdInvalid if gone is None else StatusCodes.Good)

    def due(self, now_s: float) -> None:
        """Send what is due; end the subscriptions for which nobody asks any more."""
        for each in list(self.subscriptions.values()):
            if now_s < each.due_s:
                continue
            each.due_s = max(each.due_s + each.interval_s, now_s)
            if self._publish(each, now_s):
                each.starved = 0
            else:
                each.starved += 1
            if each.starved > each.lifetime:
                self.delete(each.number)

    def next_s(self) -> float:
        return min((each.due_s for each in self.subscriptions.values()), default=float("inf"))

    def _refuse_all(self) -> None:
        while self._requests:
            request = self._requests.popleft()
            self._send(fault(request.handle, StatusCodes.BadNoSubscription), request.number)

    def _request(self, now_s: float) -> PublishRequest | None:
        while self._requests:
            request = self._requests.popleft()
            if now_s <= request.until_s:
                return request
            self._send(fault(request.handle, StatusCodes.BadTimeout), request.number)
        return None

    def _publish(self, subscription: Subscription, now_s: float) -> bool:
        """Send what there is to send; return False where no request waits for it, or the client takes nothing."""
        room = self._room()
        request = self._request(now_s) if room else None
        if request is None:
            return False
        news = subscription.gathered(room - ROOM_BESIDE - len(request.acknowledged)) if subscription.publishing else []
        if not news and subscription.silent < subscription.most_silent:
            subscription.silent += 1
            self._requests.appendleft(request)
            return True
        subscription.silent = 1
        message = _message(subscription.sequence, news)
        if news:
            subscription.keep(message)
        numbers = listed([status_bytes(number) for number in subscription.kept])
        more = b"\x01" if subscription.waiting else b"\x00"
        parts = (status_bytes(subscription.number), numbers, more, message, request.acknowledged, b"\xff\xff\xff\xff")
        self._send(answer(PUBLISH_RESPONSE, request.handle, b"".join(parts)), request.number)
        if subscription.waiting and self._requests:
            self._publish(subscription, now_s)
        return True


def _message(sequence: int, news: list[bytes]) -> bytes:
    """Return a message that tells these changes; without any it says that the subscription lives."""
    head = struct.pack("<Iq", sequence, time_100ns(time.time()))
    if not news:
        return head + bytes(4)
    body = listed(news) + b"\xff\xff\xff\xff"
    return head + b"\x01\x00\x00\x00" + DATA_CHANGE + b"\x01" + len(body).to_bytes(4, "little") + body
