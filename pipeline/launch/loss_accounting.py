"""The account of a site: what has been lost, over all sessions of its stages, from the last health of each.

A stage counts what it misses while it lives. Two things no stage can see from inside, and both show when the accounts
of all sessions are laid side by side:

* what a producer that was killed had still sent to one consumer and not to another;
* what was published while a consumer that was killed was away, and was no longer kept when it came back.

A killed consumer's last health is up to a second old, so where it counts here, it counts what was lost at most.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from itertools import pairwise

from pipeline.config.registry import STAGES, load_stage
from schemas.messages import Health, Input, StageStatus


def losses(healths: Iterable[Health]) -> dict[str, int]:
    """What each stage has lost, by its label; `healths` holds the last of every session."""
    ordered = sorted(healths, key=lambda health: health.t_ns)
    sessions: dict[str, list[Health]] = {}
    for health in ordered:
        sessions.setdefault(label(health), []).append(health)
    sent = _sent_by_the_dead(sessions)
    return {
        name: sum(health.lost for health in mine) + _never_came(mine, sent) + _while_away(mine)
        for name, mine in sessions.items()
    }


def label(health: Health) -> str:
    """Name of a stage instance in messages to people: the stage, and its tray where it has one."""
    return health.stage if health.instance == "all" else f"{health.stage}/{health.instance}"


def _sent_by_the_dead(sessions: dict[str, list[Health]]) -> Counter[tuple[str, str]]:
    """(key, producer) -> how many messages are known to have been published by sessions that others have followed."""
    dead = {health.header.producer for mine in sessions.values() for health in mine[:-1]}
    sent: Counter[tuple[str, str]] = Counter()
    for health in (health for mine in sessions.values() for health in mine):
        said = [((output.key, health.header.producer), output.published) for output in health.outputs]
        said += [((line.key, line.producer), line.next_sequence) for line in health.inputs]
        for stream, count in said:
            if stream[1] in dead:
                sent[stream] = max(sent[stream], count)
    return sent


def _never_came(mine: list[Health], sent: Counter[tuple[str, str]]) -> int:
    """Messages of dead producers that others have had: known for certain once this stage has ended in order."""
    if mine[-1].status != StageStatus.STOPPED:
        return 0
    reached: Counter[tuple[str, str]] = Counter()
    for line in (line for health in mine for line in health.inputs):
        reached[line.key, line.producer] = max(reached[line.key, line.producer], line.next_sequence)
    return sum(max(0, sent[stream] - count) for stream, count in reached.items() if stream in sent)


def _while_away(mine: list[Health]) -> int:
    """Messages that came too early for a session and too late for the one before it, which was killed."""
    if mine[-1].stage in STAGES and load_stage(mine[-1].stage).may_drop:
        return 0
    lost = 0
    for before, after in pairwise(mine):
        if before.status == StageStatus.STOPPED:
            continue
        reached = {(line.key, line.producer): line.next_sequence for line in before.inputs}
        lost += sum(
            max(0, _first_sequence(line) - reached.get((line.key, line.producer), line.next_sequence))
            for line in after.inputs
        )
    return lost


def _first_sequence(line: Input) -> int:
    return line.next_sequence - line.received - line.missing
