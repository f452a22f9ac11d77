"""Live events and large answers for many pages at once: each is made once, and whoever does not keep up misses some
events.

The stage publishes from its own thread and never waits: each reader has a bounded queue. A reader that misses events is
sent `missed` instead, and asks for the state again. (sse-starlette
would replace a handler of uvicorn.)
"""

from __future__ import annotations

import asyncio
import gzip
import json
import threading
import time
from collections.abc import AsyncIterator, Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from itertools import chain
from typing import Any

from starlette.requests import Request
from starlette.responses import Response, StreamingResponse
from starlette.types import Message, Send

COMPRESSION = 5
"""a level above takes more time than it saves bytes"""
_LEAST_COMPRESSED_BYTES = 1000


class SharedAnswer:
    """What is answered was made after it was asked for; whoever asks before its making begins gets the same."""

    def __init__(self, make: Callable[[], Any]) -> None:
        """make: what is answered as JSON; it is called in another thread, never twice at a time."""
        self._make = make
        self._one_at_a_time = asyncio.Lock()
        self._next: asyncio.Task[tuple[bytes, bytes]] | None = None

    async def to(self, request: Request) -> Response:
        """The answer to a request."""
        if self._next is None:
            self._next = asyncio.create_task(self._made())
        plain, compressed = await asyncio.shield(self._next)
        headers = {"Vary": "Accept-Encoding"}
        if compressed and "gzip" in request.headers.get("accept-encoding", ""):
            return Response(compressed, media_type="application/json", headers=headers | {"Content-Encoding": "gzip"})
        return Response(plain, media_type="application/json", headers=headers)

    async def _made(self) -> tuple[bytes, bytes]:
        async with self._one_at_a_time:
            self._next = None  # who asks from now on may know of something newer
            return await asyncio.to_thread(self._encoded)

    def _encoded(self) -> tuple[bytes, bytes]:
        plain = json.dumps(self._make(), separators=(",", ":"), ensure_ascii=False, allow_nan=False).encode()
        is_large = len(plain) >= _LEAST_COMPRESSED_BYTES
        return plain, gzip.compress(plain, COMPRESSION) if is_large else b""


MOST_WAITING = 64
"""events of one reader"""
CHECKED_EVERY_S = 5.0
"""so often it is looked whether a reader may still read"""
KEEP_ALIVE_S, NOT_READING_S = 10.0, 30.0
"""A reader without events is sent a comment, so that a dead connection shows. One that takes nothing is cut off."""
_ALIVE = b": alive\n\n"

FanName = tuple[str, int]


@dataclass(eq=False)
class _Reader:
    waiting: asyncio.Queue[bytes] = field(default_factory=lambda: asyncio.Queue(MOST_WAITING))
    has_missed: bool = False

    def put(self, event: bytes) -> None:
        """An event of this reader."""
        if self.has_missed:
            return
        try:
            self.waiting.put_nowait(event)
        except asyncio.QueueFull:
            self.has_missed = True

    def taken(self, event: bytes) -> bytes:
        """An event that has just come out of the queue, and all that wait behind it: they are sent at once."""
        events = [event]
        while not self.waiting.empty():
            events.append(self.waiting.get_nowait())
        return b"".join(events)


class LiveFeed:
    """The readers, and what is sent to them."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._readers: dict[FanName | None, list[_Reader]] = {}
        """by the fan that they look at"""
        self.looked_at: Mapping[str, Collection[int]] = {}
        """the fans that somebody looks at, by tray; replaced as a whole"""
        self._loop: asyncio.AbstractEventLoop | None = None
        """of the server, in which all readers are"""
        self._ended = False

    def publish(self, name: str, data: Any, about: FanName | None = None) -> None:
        """Send an event to all readers, or to those that look at one fan."""
        with self._lock:
            readers = self._all() if about is None else list(self._readers.get(about, ()))
        if readers:
            self._put(readers, encoded(name, data))

    @property
    def readers(self) -> int:
        """How many there are."""
        with self._lock:
            return len(self._all())

    def end(self) -> None:
        """No more events: the readers are sent away."""
        with self._lock:
            self._ended = True
            readers = self._all()
        self._put(readers, b"")

    async def events(self, first: bytes, fan: FanName | None, may_read: Callable[[], bool]) -> AsyncIterator[bytes]:
        """The events of one reader as they are sent, `first` at once.

        Args:
            first: the event that it begins with.
            fan: the one that it looks at.
            may_read: whether it may still read; asked now and then.
        """
        checked_s = time.monotonic()
        with self._joined(fan) as reader:
            yield first
            while not self._ended:
                events = _ALIVE
                with suppress(TimeoutError):
                    async with asyncio.timeout(KEEP_ALIVE_S):
                        events = reader.taken(await reader.waiting.get())
                if time.monotonic() - checked_s >= CHECKED_EVERY_S:
                    checked_s = time.monotonic()
                    if not may_read():
                        return
                if events:
                    yield events
                if reader.has_missed and reader.waiting.empty():
                    reader.has_missed = False
                    yield encoded("missed", {})

    def _put(self, readers: Sequence[_Reader], event: bytes) -> None:
        """To all of them in one go: waking the loop for each takes longer than what it does then."""

        def put() -> None:
            for each in readers:
                each.put(event)

        if readers and self._loop:
            self._loop.call_soon_threadsafe(put)

    def _all(self) -> list[_Reader]:
        return list(chain.from_iterable(self._readers.values()))

    @contextmanager
    def _joined(self, fan: FanName | None) -> Iterator[_Reader]:
        reader = _Reader()
        with self._lock:
            self._loop = asyncio.get_running_loop()
            self._readers.setdefault(fan, []).append(reader)
            self._note_looked_at()
        try:
            yield reader
        finally:
            with self._lock:
                self._readers[fan].remove(reader)
                self._note_looked_at()

    def _note_looked_at(self) -> None:
        self._readers = {fan: readers for fan, readers in self._readers.items() if readers}
        found: dict[str, list[int]] = {}
        for tray, number in filter(None, self._readers):
            found.setdefault(tray, []).append(number)
        self.looked_at = found


class EventStream(StreamingResponse):
    """The answer that events are. It ends if its reader takes nothing for long."""

    media_type = "text/event-stream"

    async def stream_response(self, send: Send) -> None:
        """Send all of it."""

        async def send_in_time(message: Message) -> None:
            async with asyncio.timeout(NOT_READING_S):
                await send(message)

        with suppress(TimeoutError):
            await super().stream_response(send_in_time)


def encoded(name: str, data: Any) -> bytes:
    """An event of a text/event-stream."""
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    return f"event: {name}\ndata: {text}\n\n".encode()
