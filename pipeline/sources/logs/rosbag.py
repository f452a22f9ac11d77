"""ROS bags, of ROS 2 or ROS 1: fields are called `/topic.field`, with `[i]` for an element of an array.

The time of a value is `header.stamp` of its message, if all messages of its topic have one that is set and goes on;
otherwise when the bag got it. A topic or message that cannot be read costs itself, and is named in a note.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from zstandard import ZstdDecompressor, ZstdError

from fantwin.pipeline.sources.column_file import Column, ColumnFile, LogError, in_one_line
from fantwin.pipeline.sources.logs.bag_files import ZSTD_START, Topic, bag_files
from fantwin.schemas.messages import Array
from fantwin.schemas.units import NS_PER_S

MOST_ELEMENTS = 1024
"""elements of an array; a longer one is an image or a cloud and no row of fans"""
MOST_APART_NS = NS_PER_S
"""from the stamp of a message to its receipt; where they are further apart, they are of two clocks"""
_LONGEST_TYPE = 80
_NO_VALUES = ("header", "layout")
"""fields with a time, or the shape of an array"""
_UNREADABLE = (ArithmeticError, AssertionError, LookupError, MemoryError, RecursionError, TypeError, ValueError)
"""what decoding of damaged or unknown messages raises, beside the errors of rosbags and struct"""


@dataclass
class _Messages:
    """The messages of one topic: times of receipt, stamps (0: none), and of each field its messages and values."""

    received_ns: list[int] = field(default_factory=list[int])
    stamps_ns: list[int] = field(default_factory=list[int])
    values: dict[str, tuple[list[int], list[float]]] = field(default_factory=dict[str, tuple[list[int], list[float]]])

    def add(self, name: str, received_ns: int, message: Any) -> None:
        self.stamps_ns.append(_stamp_ns(message))
        self.received_ns.append(received_ns)
        for each, value in _numbers(name, message):
            rows, values = self.values.setdefault(each, ([], []))
            rows.append(len(self.received_ns) - 1)
            values.append(value)

    @property
    def without_stamps(self) -> str:
        """Why the stamps are no times; empty: they are."""
        stamps = np.array(self.stamps_ns, np.int64)
        lacking = int(np.count_nonzero(stamps == 0))
        if lacking == len(stamps):
            return "messages without a time of their own"
        if lacking:
            return f"{lacking} of {len(stamps)} messages without a time of their own"
        back = -np.diff(stamps, prepend=stamps[:1])
        if np.any(back > NS_PER_S):
            return f"header.stamp goes back by {back.max() / NS_PER_S:.3f} s, as if the clock had been set"
        return ""

    @property
    def apart_ns(self) -> int:
        """Median time from the stamps to the receipt."""
        return int(np.median(np.array(self.received_ns, np.int64) - np.array(self.stamps_ns, np.int64)))


class RosbagFile(ColumnFile):
    """A bag whose messages have been read."""

    def __init__(self, path: Path) -> None:
        """Raises LogError."""
        bag = bag_files(path)
        self._topics: dict[str, _Messages] = {}
        seen: Counter[str] = Counter()
        lost: dict[Topic, Counter[str]] = {}
        for topic, received_ns, data in bag.messages():
            seen[topic.name] += 1
            try:
                message = _decoder(topic)(data)
            except _unreadable() as error:
                lost.setdefault(topic, Counter())[_reason(topic, error)] += 1
            else:
                self._topics.setdefault(topic.name, _Messages()).add(topic.name, received_ns, message)
        self._of_field = {name: topic for topic, found in self._topics.items() for name in found.values}
        self.names: Sequence[str] = list(self._of_field)
        lacking = [
            f"{name}: {seen[name]} of the {count} messages that metadata.yaml counts are in the files"
            for name, count in bag.counts.items()
            if seen[name] < count
        ]
        self._notes = [*bag.notes, *(_left_out(each, why, seen) for each, why in sorted(lost.items())), *lacking]
        self.notes: Sequence[str] = self._notes
        if not self.names:
            texts = "its messages have no numbers" if self._topics else "no message"
            raise LogError(f"{path}: nothing to import in this ROS bag: {'; '.join(self._notes[:3]) or texts}")

    def read(self, names: Sequence[str]) -> Mapping[str, Column]:
        """See ColumnFile."""
        used = list(dict.fromkeys(self._of_field[name] for name in names))
        why = {name: self._topics[name].without_stamps for name in used}
        by_receipt = {name for name in used if why[name]}
        reasons = list(dict.fromkeys(filter(None, why.values())))
        notes = [f"{_topics_of(why, each)}: {each}; that of the bag is used" for each in reasons]
        stamped = [name for name in used if name not in by_receipt]
        far = [name for name in stamped if by_receipt and abs(self._topics[name].apart_ns) > MOST_APART_NS]
        if far:
            apart_s = self._topics[far[0]].apart_ns / NS_PER_S
            notes.append(
                f"{', '.join(far)}: header.stamp is of another clock, {apart_s:.0f} s from that of the bag, which is "
                "used"
            )
            by_receipt |= set(stamped)
        self.notes = [*self._notes, *notes]
        times = {
            name: np.array(found.received_ns if name in by_receipt else found.stamps_ns, np.int64)
            for name, found in ((name, self._topics[name]) for name in used)
        }
        return {name: self._series(name, times[self._of_field[name]]) for name in names}

    def _series(self, name: str, t_ns: Array) -> Column:
        rows, values = self._topics[self._of_field[name]].values[name]
        return Column(t_ns[rows], np.array(values))


def _topics_of(why: Mapping[str, str], reason: str) -> str:
    return ", ".join(sorted(name for name, each in why.items() if each == reason))


def _left_out(topic: Topic, why: Counter[str], seen: Counter[str]) -> str:
    reason, _ = why.most_common(1)[0]
    if why.total() == seen[topic.name]:
        return f"{topic.name} is left out: {reason}"
    return f"{topic.name}: {why.total()} of {seen[topic.name]} messages cannot be read: {reason}"


def _reason(topic: Topic, error: Exception) -> str:
    if isinstance(error, KeyError):
        needed = "" if str(error).strip("'") == topic.type else f", which has fields of {str(error)[:_LONGEST_TYPE]}"
        return f"the bag does not define its type {topic.type}{needed}"
    return in_one_line(error)


@cache
def _unreadable() -> tuple[type[Exception], ...]:
    from rosbags.serde import SerdeError  # noqa: PLC0415
    from rosbags.typesys import TypesysError  # noqa: PLC0415

    return (*_UNREADABLE, SerdeError, TypesysError, ZstdError, struct.error)


@cache
def _decoder(topic: Topic) -> Callable[[bytes], Any]:
    """What makes a message of its data, or says why it cannot, each time."""
    from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore  # noqa: PLC0415  an extra
    from rosbags.typesys.msg import normalize_msgtype  # noqa: PLC0415

    if topic.encoding not in ("cdr", "ros1"):
        return _refusing(
            ValueError(f"its messages are {topic.encoding or 'of no known form'}, not cdr as usual in ROS")
        )
    # old bags in SQLite, and some of ROS 1, do not hold their types; those of ROS itself are then known
    usual = Stores.LATEST if topic.encoding == "cdr" else Stores.ROS1_NOETIC
    store = get_typestore(Stores.EMPTY if topic.definition else usual)
    try:
        if topic.definition.startswith(f"{'=' * 80}\nIDL: "):
            for part in topic.definition.split(f"{'=' * 80}\n")[1:]:
                store.register(get_types_from_idl(part.partition("\n")[2]))
        elif topic.language.endswith("idl"):
            store.register(get_types_from_idl(topic.definition))
        elif topic.definition:
            store.register(get_types_from_msg(topic.definition, topic.type))
    except _unreadable():
        what = "is of a service or action" if "\n---" in topic.definition else "has a definition that cannot be read"
        return _refusing(ValueError(f"its type {topic.type} {what}"))
    decode = store.deserialize_cdr if topic.encoding == "cdr" else store.deserialize_ros1
    kind = normalize_msgtype(topic.type)

    def decoded(data: bytes) -> Any:
        packed = data.startswith(ZSTD_START)
        return decode(ZstdDecompressor().decompress(data) if packed else data, kind)

    return decoded


def _refusing(error: ValueError) -> Callable[[bytes], Any]:
    def refuse(_: bytes) -> Any:
        raise error

    return refuse


def _stamp_ns(message: Any) -> int:
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    return stamp.sec * NS_PER_S + stamp.nanosec if stamp is not None else 0


def _numbers(name: str, value: Any) -> Iterator[tuple[str, float]]:
    """The numbers of a message, with their names."""
    if isinstance(value, bool | int | float | np.number):
        yield name, float(value)
    elif is_dataclass(value):
        for each in _fields_of(type(value)):
            yield from _numbers(f"{name}.{each}", getattr(value, each))
    elif isinstance(value, np.ndarray | list | tuple) and len(value) <= MOST_ELEMENTS:
        for number, element in enumerate(value):
            yield from _numbers(f"{name}[{number}]", element)


@cache
def _fields_of(kind: type[Any]) -> tuple[str, ...]:
    """The fields of a message that may have numbers."""
    return tuple(each.name for each in fields(kind) if each.name not in _NO_VALUES and not each.name.startswith("__"))
