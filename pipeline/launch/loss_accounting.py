"""What a site has lost, over all sessions of its stages, computed from the last health of each session.

A stage counts what it misses while it runs. No stage can detect two kinds of loss by itself; comparing the healths of
all sessions reveals them:

* a producer was killed, and a message had reached one consumer and not another;
* a consumer was killed, and a message published meanwhile was no longer kept when the consumer came back.

A killed consumer's last health is up to a second old, so the second count is an upper bound.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from itertools import chain, pairwise

from pipeline.config.registry import STAGES
from pipeline.runtime.stage import load_stage
from schemas.messages import Health, StageStatus
from schemas.streams import StreamId, input_streams, output_streams


def losses(healths: Iterable[Health]) -> dict[str, int]:
    """What each stage has lost, by its label; `healths` holds the last of every session."""
    ordered = sorted(healths, key=lambda health: health.t_ns)
    sessions: dict[str, list[Health]] = {}
    for health in ordered:
        sessions.setdefault(label(health), []).append(health)
    published = _published_by_replaced(sessions)
    return {
        name: sum(health.lost for health in own) + _never_arrived(own, published) + _while_away(own)
        for name, own in sessions.items()
    }


def label(health: Health) -> str:
    """Name of a stage instance in messages to people: the stage, and its tray where it has one."""
    return health.stage if health.instance == "all" else f"{health.stage}/{health.instance}"


def _published_by_replaced(sessions: dict[str, list[Health]]) -> Counter[StreamId]:
    """How many messages are known to have been published on each stream of a session that was followed by another."""
    replaced = {health.header.producer for own in sessions.values() for health in own[:-1]}
    published: Counter[StreamId] = Counter()
    for health in chain.from_iterable(sessions.values()):
        received = {stream: state.next_sequence or 0 for stream, state in input_streams(health).items()}
        for stream, count in chain(output_streams(health).items(), received.items()):
            if stream[1] in replaced:
                published[stream] = max(published[stream], count)
    return published


def _never_arrived(own: list[Health], published: Counter[StreamId]) -> int:
    """Messages of replaced producers that others received. Certain only once this stage has stopped."""
    if own[-1].status != StageStatus.STOPPED:
        return 0
    received: Counter[StreamId] = Counter()
    for stream, state in chain.from_iterable(input_streams(health).items() for health in own):
        received[stream] = max(received[stream], state.next_sequence or 0)
    return sum(max(0, published[stream] - count) for stream, count in received.items() if stream in published)


def _while_away(own: list[Health]) -> int:
    """Messages between the last that a killed session had and the first that its successor had."""
    killed = [(before, after) for before, after in pairwise(own) if before.status != StageStatus.STOPPED]
    if not killed or (own[-1].stage in STAGES and load_stage(own[-1].stage).may_drop):
        return 0
    lost = 0
    for before, after in killed:
        had = input_streams(before)
        for stream, state in input_streams(after).items():
            if stream in had:
                lost += max(0, state.first_sequence - (had[stream].next_sequence or 0))
    return lost
