"""The account of a recording: of every key and producer, what was recorded, what is missing, what came twice.

A producer numbers its messages on a key without gaps, so every hole between the first and the last is a loss.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, fields, replace

from schemas.messages import Health
from schemas.streams import StreamId, StreamState, output_streams
from schemas.topics import topic_of

LEDGER_NAME = "fantwin.ledger"
"""the metadata record that holds a finished ledger"""
ENDED = "ended"
"""its entry that says that the recorder ended in order with this part"""
RECOVERED = "recovered"
"""its entry that says what was lost, or may have been, in a file that was mended"""
BEFORE_NAME = "fantwin.before"
"""the one, before the first message, that says with which number each producer should go on"""


@dataclass(slots=True)
class StreamCounts:
    """Of one key and producer. `missing` counts holes, that before the first message included where it is known what
    had been recorded before. Sequence numbers and times, of receipt, are of the messages here; None without any.
    Of a damaged file `last_sequence` is that of the last message that was recorded."""

    messages: int = 0
    missing: int = 0
    duplicated: int = 0
    first_sequence: int | None = None
    last_sequence: int | None = None
    first_ns: int | None = None
    last_ns: int | None = None


_FIGURES = {field.name for field in fields(StreamCounts)}


class SequenceLedger:
    """Kept message by message, in the order in which they are recorded."""

    def __init__(self, before: Mapping[StreamId, int] | None = None) -> None:
        """before: with which sequence number each producer should go on, where parts have gone before."""
        self.accounts: dict[StreamId, StreamCounts] = {}
        self._streams = {stream: StreamState(sequence) for stream, sequence in (before or {}).items()}
        self._published: dict[StreamId, int] = {}

    def note(self, key: str, producer: str, sequence: int, log_time_ns: int) -> None:
        """A message was recorded. A twin's card is written again at the start of each part, and counts once."""
        line = (key, producer)
        state = self._state(line)
        if state.is_duplicate(sequence) and key.endswith("/twin"):
            return
        account = self.accounts.get(line)
        if account is None:
            account = self.accounts[line] = StreamCounts()
        if account.messages == 0:
            account.first_sequence = sequence
        account.messages += 1
        if account.first_ns is None or log_time_ns < account.first_ns:  # the host's clock may be set back
            account.first_ns = log_time_ns
        if account.last_ns is None or log_time_ns > account.last_ns:
            account.last_ns = log_time_ns
        if state.accept(sequence):
            account.last_sequence = sequence
        account.missing, account.duplicated = state.missing, state.duplicated

    @property
    def next(self) -> dict[StreamId, int]:
        """The sequence number each producer should go on with."""
        streams = self._streams.items()
        return {stream: state.next_sequence for stream, state in streams if state.next_sequence is not None}

    def note_health(self, health: Health) -> None:
        """A health was recorded: it says how much its stage had published by then."""
        for stream, published in output_streams(health).items():
            self._published[stream] = published
            if published == 0 and _is_recorded(stream[0]):
                self._state(stream).skip_to(0)  # from its first message on, each is recorded or missing

    def lose(self, key: str, producer: str, sequence: int) -> None:
        """A message came that is not going to be recorded: a hole, as soon as a later one is, or else at the end."""
        line = (key, producer)
        state = self._state(line)
        if state.next_sequence is None:
            state.skip_to(sequence)
        self._published[line] = max(sequence + 1, self._published.get(line, 0))

    def note_duplicated(self, key: str, producer: str, count: int = 1) -> None:
        """Messages came again and were not recorded again."""
        state = self._state((key, producer))
        state.duplicated += count
        self.accounts.setdefault((key, producer), StreamCounts()).duplicated = state.duplicated

    def unrecorded(self) -> dict[StreamId, int]:
        """How many messages are known to have been published after the last one recorded, above all by healths."""
        due = self.next
        behind = {line: published - due.get(line, published) for line, published in self._published.items()}
        return {line: count for line, count in behind.items() if count > 0}

    def settle(self) -> None:
        """The session is over: what was published and has not come is missing."""
        for line in self.unrecorded():
            state = self._state(line)
            state.skip_to(self._published[line])
            self.accounts.setdefault(line, StreamCounts()).missing = state.missing

    def _state(self, stream: StreamId) -> StreamState:
        state = self._streams.get(stream)
        if state is None:
            state = self._streams[stream] = StreamState()
        return state

    def following(self) -> SequenceLedger:
        """An empty one for the part after this."""
        ledger = SequenceLedger(self.next)
        ledger._published = self._published
        return ledger

    def before_as_metadata(self) -> dict[str, str]:
        """`next` as text for a metadata record; only sensible before the first message."""
        return {" ".join(line): str(sequence) for line, sequence in self.next.items()}


def as_metadata(accounts: Mapping[StreamId, StreamCounts]) -> dict[str, str]:
    """Text for a metadata record: key and producer to the account as JSON."""
    return {" ".join(line): json.dumps(asdict(account)) for line, account in accounts.items()}


def accounts_of(metadata: Mapping[str, str]) -> dict[StreamId, StreamCounts]:
    """What `as_metadata` has written. Raises ValueError if it is not that."""
    accounts = {}
    for name, text in metadata.items():
        if name not in (ENDED, RECOVERED):
            values = json.loads(text)
            if not isinstance(values, dict) or values.keys() != _FIGURES:
                raise ValueError(f"{name}: no account")
            if not all(value is None or type(value) is int for value in values.values()):
                raise ValueError(f"{name}: an account of something else than numbers")
            accounts[_line(name)] = StreamCounts(**values)
    return accounts


def recovered_of(metadata: Mapping[str, str]) -> tuple[str, ...]:
    """What the ledger of a mended file says of it, one line each. Raises ValueError if it is not that."""
    lines = json.loads(metadata.get(RECOVERED, "[]"))
    if not isinstance(lines, list) or not all(isinstance(line, str) for line in lines):
        raise ValueError(f"{RECOVERED}: no lines")
    return tuple(lines)


def corrected(
    recorded: Mapping[StreamId, StreamCounts], found: Mapping[StreamId, StreamCounts]
) -> dict[StreamId, StreamCounts]:
    """The ledger of a file that has been damaged since: what it says was recorded and is not found is missing."""
    accounts = dict(found)
    for line, said in recorded.items():
        here = found.get(line, StreamCounts())
        accounts[line] = replace(
            said,
            messages=here.messages,
            missing=said.missing + max(0, said.messages - here.messages),
            first_sequence=here.first_sequence,
            first_ns=here.first_ns,
            last_ns=here.last_ns,
        )
    return accounts


def next_of(before: Mapping[StreamId, int], accounts: Mapping[StreamId, StreamCounts]) -> dict[StreamId, int]:
    """With which number each producer should go on after a part."""
    last = {line: account.last_sequence for line, account in accounts.items()}
    return dict(before) | {line: sequence + 1 for line, sequence in last.items() if sequence is not None}


def before_of(metadata: Mapping[str, str]) -> dict[StreamId, int]:
    """What `before_as_metadata` has written. Raises ValueError if it is not that."""
    return {_line(name): int(text) for name, text in metadata.items()}


def add_up(accounts: Iterable[tuple[StreamId, StreamCounts]]) -> dict[str, StreamCounts]:
    """The accounts of each key together, by key; sequence numbers, which are each producer's own, left out."""
    found: dict[str, StreamCounts] = {}
    for (key, _), account in accounts:
        total = found.setdefault(key, StreamCounts())
        total.messages += account.messages
        total.missing += account.missing
        total.duplicated += account.duplicated
        if account.first_ns is not None and account.last_ns is not None:
            total.first_ns = min(account.first_ns, total.first_ns if total.first_ns is not None else account.first_ns)
            total.last_ns = max(account.last_ns, total.last_ns or 0)
    return dict(sorted(found.items()))


def _is_recorded(key: str) -> bool:
    try:
        return topic_of(key).recorded
    except KeyError:
        return False


def _line(name: str) -> StreamId:
    key, _, producer = name.partition(" ")
    return key, producer
