"""What a site has lost, over all sessions of its stages, computed from the last health of each session.

A stage counts what it misses while it runs. The health messages of all sessions together show what it cannot know: what
was published before it first heard a producer, while it was dead, or after it had stopped. There is one rule: of every
stream that a stage reads, each message from the first that is due to it to the last must have reached one of its
sessions.

* First: number 0 where one launcher started both producer and consumer. Otherwise the first that the stage had: what
  came before is history, and so is what was published between two sessions of which the earlier stopped in order.
* Last: once the stage has stopped, the last that is known to be published, if its producer had ended by then: it was
  replaced, or the launcher stopped it first. Otherwise the last that the stage had: more may be on the way.

A killed consumer's last health is up to a second old, so what it had not reported counts as lost: an upper bound.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import TypeAlias

from pipeline.config.registry import STAGES
from pipeline.runtime.stage import load_stage
from schemas.messages import Health, StageStatus
from schemas.streams import StreamId, StreamState, input_streams, output_streams
from schemas.topics import HEALTH_CHUNK, current_name

Launched: TypeAlias = tuple[str, int]
"""label and process id of a session"""
NOT_PROCESSED = "lost_at_stop"
"""the counter of a stage of what had arrived when it had to end; a part of it is not among what it received"""


def losses(healths: Iterable[Health], launched: Collection[Launched] = ()) -> dict[str, int]:
    """What each stage has lost, by its label.

    Args:
        healths: the last of every session, in the order in which they were heard.
        launched: the sessions that one launcher has started; `healths` has all of them.
    """
    sessions: dict[str, list[_Session]] = {}
    for health in healths:
        is_ours = (label(health), health.process_id) in launched
        sessions.setdefault(label(health), []).append(_Session(health, input_streams(health), is_ours))
    published = _published(sessions)
    return {
        name: sum(each.health.lost for each in own) + _never_received(own, published) for name, own in sessions.items()
    }


def label(health: Health) -> str:
    """Name of a stage instance in messages to people: the stage, and its tray where it has one."""
    return health.stage if health.instance == "all" else f"{health.stage}/{health.instance}"


@dataclass(frozen=True, slots=True)
class _Session:
    """A session of a stage: its last health, what that says it received, and whether it is one of the launched."""

    health: Health
    inputs: dict[StreamId, StreamState]
    is_launched: bool

    @property
    def has_stopped(self) -> bool:
        """Whether it ended in order."""
        return self.health.status == StageStatus.STOPPED


@dataclass(slots=True)
class _Published:
    """What is known of a stream.

    Attributes:
        count: so many messages have been published.
        is_replaced: its producer was followed by another session of its stage.
        launched_stage: the stage of its producer, if that is one of the launched sessions.
    """

    count: int = 0
    is_replaced: bool = False
    launched_stage: str = ""


def _published(sessions: dict[str, list[_Session]]) -> dict[StreamId, _Published]:
    """All streams that have a producer's name, by what producers and consumers say."""
    replaced = {each.health.header.producer for own in sessions.values() for each in own[:-1]}
    every = list(chain.from_iterable(sessions.values()))
    stages = {each.health.header.producer: each.health.stage for each in every if each.is_launched}
    found: dict[StreamId, _Published] = {}
    for each in every:
        received = {stream: state.next_sequence or 0 for stream, state in each.inputs.items()}
        for stream, count in chain(output_streams(each.health).items(), received.items()):
            key, producer = stream
            if producer:  # without a name: earlier producers, summed up
                known = found.setdefault(stream, _Published())
                known.count = max(known.count, count)
                known.is_replaced = producer in replaced
                known.launched_stage = "" if _is_of_health(key) else stages.get(producer, "")
    return found


def _never_received(own: Sequence[_Session], published: dict[StreamId, _Published]) -> int:
    """Messages that were due to a stage and are in no count of its sessions `own`."""
    ours = [each for each in own if each.is_launched]
    from_ours = {stream for stream, known in published.items() if ours and known.launched_stage}
    never = sum(
        _absent(ours, stream, published[stream], first=0) for stream in from_ours if _reads(ours[-1].health, stream[0])
    )
    for run in _runs(own):
        others = {stream for each in run for stream in each.inputs} & published.keys() - from_ours
        never += sum(_absent(run, stream, published[stream], first=None) for stream in others)
    counters = chain.from_iterable(each.health.counters for each in own)
    never = max(0, never - sum(counter.value for counter in counters if counter.name == NOT_PROCESSED))
    stage = own[-1].health.stage
    return 0 if never and stage in STAGES and load_stage(stage).may_drop else never


def _runs(own: Sequence[_Session]) -> list[list[_Session]]:
    """Sessions that follow one another without a stop in order."""
    runs: list[list[_Session]] = []
    for each in own:
        if not runs or runs[-1][-1].has_stopped:
            runs.append([])
        runs[-1].append(each)
    return runs


def _absent(run: Sequence[_Session], stream: StreamId, known: _Published, first: int | None) -> int:
    """How many messages of a stream, from number `first`, reached none of these sessions of a stage. None: from the
    first that one of them had."""
    states = [each.inputs[stream] for each in run if stream in each.inputs]
    if not states and any((stream[0], "") in each.inputs for each in run):
        return 0  # it may be among the streams that were forgotten in a flood of names
    had = sorted((state.first_sequence, state.next_sequence or 0) for state in states)
    due, absent = had[0][0] if first is None else first, 0
    for begin, end in had:
        absent += max(0, begin - due)
        due = max(due, end)
    has_ended = known.is_replaced or _is_stopped_before(known.launched_stage, run[-1].health.stage)
    return absent + (max(0, known.count - due) if has_ended and run[-1].has_stopped else 0)


def _is_stopped_before(producer: str, consumer: str) -> bool:
    """Whether a launcher stops the stage `producer` before `consumer`: in the order of the data flow."""
    order = list(STAGES)
    return producer in STAGES and consumer in STAGES and order.index(producer) < order.index(consumer)


def _reads(health: Health, key: str) -> bool:
    """Whether the stage that reports this is configured to read a key of a tray."""
    if health.stage not in STAGES:
        return False
    tray, topic = key.split("/")[-2:]
    is_its_tray = STAGES[health.stage].scope == "site" or tray == health.instance
    return is_its_tray and current_name(topic) in load_stage(health.stage).reads


def _is_of_health(key: str) -> bool:
    return key.split("/")[2:3] == [HEALTH_CHUNK]
