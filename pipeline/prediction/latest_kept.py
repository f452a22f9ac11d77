"""Things that take a while to build and are used again: the latest ones are kept."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

Thing = TypeVar("Thing")


class LatestKept(Generic[Thing]):
    """Keeps the latest things by key. functools.lru_cache would need all that a thing is built from in its key."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._kept: dict[Hashable, Thing] = {}
        """the one that was used last is the last"""

    def get(self, key: Hashable, build: Callable[[], Thing]) -> Thing:
        """The thing of a key; it is built if it is not kept."""
        self._kept[key] = found = self._kept.pop(key) if key in self._kept else build()
        if len(self._kept) > self._most:
            del self._kept[next(iter(self._kept))]
        return found
