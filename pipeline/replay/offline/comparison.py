"""The comparison of a replay with what was recorded, within a tolerance; by snapshots where scores are not recorded.

Decisions are compared exactly. The last digits of numbers depend on the processor: matrix products and functions such
as tanh are computed in another order, or with another rounding, by each kernel of BLAS, NumPy and ONNX Runtime. Scores
are recorded with seven digits, so one unit in the last of them is a relative difference of up to 1.2e-7.
docs/how-to/replay.md has the differences that were measured.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.recordings.dates import format_utc
from fantwin.pipeline.replay.offline.plan import BEGINNING, Limit, Session
from fantwin.schemas.codec import CodecError
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.messages import Array, ScorerSnapshot
from fantwin.scoring.model.saved import from_json

RELATIVE = 1e-6
"""share of the larger of both numbers: eight units in the last digit of a recorded score"""
SPEED_RAD_S = 1e-6
"""absolute, of speeds and variances of speeds: a hundred-thousandth of a revolution a minute"""
OTHERS = 1e-9
"""absolute, of all other numbers: scores, torque balances, probabilities, sizes of faults"""
SENTENCES = frozenset({"message", "evidence"})
"""texts with numbers that are rounded from other fields; all other texts are compared exactly"""

_NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")


class Apart(NamedTuple):
    """A difference of two numbers."""

    share: float = 0.0
    """share of the tolerance; 0: equal"""
    name: str = ""
    difference: float = 0.0


def shares(name: str, one: Array, other: Array) -> Array:
    """The differences of unequal numbers, as shares of the tolerance for their name, which ends in their unit.

    A share is infinite if only one of both numbers is finite.
    """
    one, other = one.astype(np.float64), other.astype(np.float64)
    absolute = SPEED_RAD_S if name.endswith(("_rad_s", "variance")) else OTHERS
    with np.errstate(invalid="ignore"):
        share = np.abs(one - other) / (absolute + RELATIVE * np.maximum(np.abs(one), np.abs(other)))
    return np.where(np.isfinite(share), share, math.inf)


def differences(one: Any, other: Any, note: Callable[[Apart], None], path: tuple[str, ...] = ()) -> Iterator[str]:
    """The places in which two nested values differ by more than the tolerance: keys and list indices, joined by dots.

    Sentences are compared without their numbers, because these are rounded from numbers that are compared anyway.
    note: called with each difference within the tolerance, of an array with the largest.
    """
    if isinstance(one, dict) and isinstance(other, dict):
        for key in {**one, **other}:
            if key in one and key in other:
                yield from differences(one[key], other[key], note, (*path, key))
            else:
                yield ".".join((*path, key))
    elif isinstance(one, list | tuple) and isinstance(other, list | tuple) and len(one) == len(other):
        for number, (mine, others) in enumerate(zip(one, other, strict=True)):
            if mine != others:
                yield from differences(mine, others, note, (*path, str(number)))
    elif isinstance(one, np.ndarray) or isinstance(other, np.ndarray) or one != other:
        apart = _apart(path, one, other)
        if apart.share > 1.0:
            yield ".".join(path)
        elif apart.share:
            note(apart)


def unequal(name: str, one: Array, other: Array) -> tuple[Array, Array]:
    """Flags of the values that differ between two arrays of one shape and type, where all NaN are equal; and the share
    of the tolerance that each of these takes, infinite if they are not floats."""
    differs = one != other
    if one.dtype.kind != "f":
        return differs, np.full(int(differs.sum()), math.inf)
    differs &= ~(np.isnan(one) & np.isnan(other))
    return differs, shares(name, one[differs], other[differs])


def _arrays_apart(name: str, one: Array, other: Array) -> Apart:
    if one.shape != other.shape or one.dtype != other.dtype:
        return Apart(math.inf)
    differs, share = unequal(name, one, other)
    if not share.size:
        return Apart()
    largest = int(np.argmax(share))
    return Apart(float(share[largest]), name, abs(float(one[differs][largest]) - float(other[differs][largest])))


def _apart(path: tuple[str, ...], one: Any, other: Any) -> Apart:
    name = next((key for key in reversed(path) if not key.isdigit()), "")
    if isinstance(one, np.ndarray) and isinstance(other, np.ndarray):
        return _arrays_apart(name, one, other)
    if isinstance(one, str) and isinstance(other, str) and name in SENTENCES:
        is_alike = _NUMBER.sub("#", one) == _NUMBER.sub("#", other)
        return Apart(0.0 if is_alike else math.inf)
    if isinstance(one, float) and isinstance(other, float):
        if math.isnan(one) and math.isnan(other):
            return Apart()
        return Apart(float(shares(name, np.array(one), np.array(other))), name, abs(one - other))
    return Apart(math.inf)


MAX_NAMED = 5
"""differences that are described"""


class CannotCompareError(UserError):
    """The replay cannot be compared with the recording."""


@dataclass
class Comparison:
    """The result for one tray. Samples are those of the tray, with all fans."""

    tray: str
    equal: int = 0
    different: int = 0
    """replayed with another decision, or with a number that differs by more than its tolerance"""
    numbers_different: int = 0
    """the different samples with such a number"""
    not_made: int = 0
    """recorded, and not replayed"""
    not_recorded: int = 0
    """replayed, and not in the recording: in flight when it ended, or lost"""
    holes: int = 0
    """those between recorded ones: they were lost, or removed"""
    inputs_different: int = 0
    """samples of `grid` and `prediction` that were replayed differently"""
    alarms_equal: int = 0
    alarms_different: int = 0
    alarms_not_recorded: int = 0
    """replayed, and later than the last recorded score of their session"""
    not_comparable: int = 0
    """not equal or not replayed, where the recording lacks what they were computed from"""
    alarms_not_comparable: int = 0
    has_scores: bool = True
    """scores were recorded; otherwise snapshots are compared"""
    snapshots_equal: int = 0
    snapshots_different: int = 0
    snapshots_not_comparable: int = 0
    largest: Apart = Apart()
    """the largest difference within the tolerance, by its share of the tolerance"""
    reasons: list[str] = field(default_factory=list)
    """why something is not comparable, a line each"""
    named: list[str] = field(default_factory=list)
    """the first differences, a line each"""

    @property
    def is_equal(self) -> bool:
        """Whether nothing differs."""
        return not (
            self.different
            or self.inputs_different
            or self.not_made
            or self.alarms_different
            or self.snapshots_different
        )

    @property
    def has_content(self) -> bool:
        """Whether anything could be compared."""
        if self.has_scores:
            return bool(self.equal or self.different or self.not_made)
        return bool(self.alarms_equal or self.snapshots_equal or not self.is_equal)

    def note(self, apart: Apart) -> None:
        """Keep the largest of the differences within the tolerance."""
        self.largest = max(self.largest, apart)

    def add_not_comparable(self, samples: int, limit: Limit) -> None:
        """Count samples beyond the limit of their session."""
        self.not_comparable += samples
        if samples:
            self.add_limit(limit)

    def add_limit(self, limit: Limit) -> None:
        """Add the reason why something beyond the limit of its session is not comparable."""
        since = "" if limit.t_ns == BEGINNING else f"after {format_utc(limit.t_ns)}: "
        self.add_reason(f"{self.tray}: {since}{limit.reason}")

    def add_reason(self, reason: str) -> None:
        """Add a line on what is not comparable, once."""
        if reason not in self.reasons:
            self.reasons.append(reason)

    def name(self, difference: str) -> None:
        """Describe a difference, if it is one of the first."""
        if len(self.named) < MAX_NAMED:
            self.named.append(difference)


class SnapshotVerifier:
    """Compares the snapshots of a replay of one tray with the recorded ones, session by session, in order.

    Where scores are not recorded, they show that every statistic and alarm was the same, and all that was learned of
    the fans. A scorer takes snapshots at the end of a block of samples. A replay has other blocks, so it takes its own
    at the samples of the recorded ones.
    """

    def __init__(
        self, read: Callable[[], Iterable[Envelope]], limit_of: Callable[[str], Limit], found: Comparison
    ) -> None:
        """read: the recorded snapshots of the tray, from the beginning at each call. limit_of: the limit of a session
        of the scorer. found: takes the results."""
        self._read = read
        self._limit_of = limit_of
        self._found = found
        self._producer: str | None = None
        self._recorded: Iterator[ScorerSnapshot] = iter(())
        self._next: ScorerSnapshot | None = None
        self._made: list[ScorerSnapshot] = []
        """those of one time: a request is answered between two samples"""
        self._visited: set[str] = set()

    def add(self, producer: str, made: ScorerSnapshot) -> None:
        """Compare the next replayed snapshot, of the recorded session `producer`."""
        if producer != self._producer:
            self._begin_session(producer)
        if self._made and made.t_ns != self._made[0].t_ns:
            self._settle(made.t_ns)
        self._made.append(made)

    def finish(self, sessions: Sequence[Session]) -> None:
        """Compare what is left."""
        for session in sessions:
            if session.producer not in self._visited:
                self._begin_session(session.producer)
        self._settle(None)

    def _begin_session(self, producer: str) -> None:
        self._settle(None)
        self._producer = producer
        self._visited.add(producer)
        self._recorded = _saved(self._read(), producer)
        self._next = next(self._recorded, None)

    def _settle(self, until_t_ns: int | None) -> None:
        """Compare the recorded snapshots before a time; None: all."""
        while self._next is not None and (until_t_ns is None or self._next.t_ns < until_t_ns):
            made = [each for each in self._made if each.t_ns == self._next.t_ns]
            self._compare(self._next, made)
            self._next = next(self._recorded, None)
        self._made = []

    def _compare(self, recorded: ScorerSnapshot, made: Sequence[ScorerSnapshot]) -> None:
        found = self._found
        places = [first_difference(each, recorded, found.note) for each in made]
        if "" in places:
            found.snapshots_equal += 1
            return
        limit = self._limit_of(self._producer or "")
        at = f"{found.tray}: snapshot of {format_utc(recorded.t_ns)}"
        if recorded.t_ns > limit.t_ns:
            found.snapshots_not_comparable += 1
        elif not places:
            found.snapshots_different += 1
            found.name(f"{at}: recorded and not replayed")
        else:
            found.snapshots_different += 1
            found.name(f"{at}: {places[-1]} differs")


def first_difference(
    made: ScorerSnapshot, recorded: ScorerSnapshot, note: Callable[[Apart], None] = lambda _apart: None
) -> str:
    """The first place in which two snapshots differ by more than the tolerance; empty if none.

    note: see `differences`.
    """
    if made.twin_sha256 != recorded.twin_sha256:
        return "twin_sha256"
    if made.state_json == recorded.state_json:
        return ""
    try:
        one, other = (_state(snapshot) for snapshot in (made, recorded))
    except (ValueError, LookupError, TypeError, AttributeError):
        return "state_json"
    return next(differences(one, other, note), "")


def _state(snapshot: ScorerSnapshot) -> dict[str, Any]:
    """What a snapshot holds, with its arrays as such."""
    state = json.loads(snapshot.state_json)
    model = state["model"]
    return state | {"model": model | {"arrays": from_json(model["arrays"])}}


def _saved(envelopes: Iterable[Envelope], producer: str) -> Iterator[ScorerSnapshot]:
    """The snapshots that a session saved, in order, each once. What cannot be decoded is reported with the plan."""
    next_sequence = 0
    for envelope in envelopes:
        try:
            message = envelope.message
        except CodecError:
            continue
        header = message.header
        if isinstance(message, ScorerSnapshot) and header.producer == producer and header.sequence >= next_sequence:
            next_sequence = header.sequence + 1
            if not message.restored:
                yield message
