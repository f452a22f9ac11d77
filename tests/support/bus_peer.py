"""A process on the bus for tests: `publish COUNT` or `collect COUNT`, controlled over standard streams.

publish: puts COUNT alarms as fast as it can, prints "published", then one more for every line on standard input.
collect: puts what comes in sequence, prints the sequence numbers when it has COUNT of them.
"""

from __future__ import annotations

import queue
import sys

from fantwin.pipeline.bus.recovery import Answer
from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.config.models import BusConfig
from fantwin.pipeline.runtime.sequence_tracker import Found, SequenceTracker
from fantwin.pipeline.runtime.tracked_streams import Request
from fantwin.schemas.codec import decode, encode, type_name
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.messages import Alarm
from fantwin.schemas.topics import BY_NAME, tray_key
from tests.support import made_messages

KEY = tray_key("site", "tray", "alarm")
TOPIC = BY_NAME["alarm"]


def publish(bus: Bus, count: int) -> None:
    publisher = bus.publisher(KEY, TOPIC, type_name(Alarm), "peer")
    for sequence in range(count):
        publisher.put(encode(alarm(sequence)))
    print("published", flush=True)
    for sequence, _ in enumerate(sys.stdin, start=count):
        publisher.put(encode(alarm(sequence)))


def alarm(sequence: int) -> Alarm:
    return made_messages.alarm(0, sequence, "tray", "peer", sequence, onset_t_ns=0, message="x" * 200)


def collect(bus: Bus, count: int) -> None:
    inbox: queue.Queue[bytes] = queue.Queue()

    def packet(payload: bytes) -> Envelope:
        return Envelope(KEY, "alarm", payload, 0, decode(Alarm, payload))

    def ask(request: Request) -> Found:
        answers: queue.SimpleQueue[Answer] = queue.SimpleQueue()
        bus.request_missed(request.key, request.producer, request.first, request.last, 5.0, answers.put)
        answer = answers.get()
        return Found([packet(payload) for _, payload in answer.messages], answer.published)

    tracker = SequenceTracker(ask)
    bus.subscribe(KEY, lambda _key, payload: inbox.put(payload))
    print("ready", flush=True)
    got: list[int] = []
    while len(got) < count:
        got += [due.message.header.sequence for due in tracker.accept(packet(inbox.get(timeout=20)))]
    print(" ".join(map(str, got)), flush=True)


if __name__ == "__main__":
    role, endpoint, number = sys.argv[1], sys.argv[2], int(sys.argv[3])
    with Bus(BusConfig(endpoint=endpoint)) as the_bus:
        (publish if role == "publish" else collect)(the_bus, number)
