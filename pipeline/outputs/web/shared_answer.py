"""An answer that many ask for at once, such as all pages after a power cut: it is made once for them, in a thread."""

from __future__ import annotations

import asyncio
import gzip
import json
from collections.abc import Callable
from typing import Any

from starlette.requests import Request
from starlette.responses import Response

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
