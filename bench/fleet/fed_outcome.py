"""What became of the trays that were fed to a site: everything recorded, every sample scored, the alarms right?

The recordings of all shards are read as those of one run. What should have been decided follows from the raw samples
that were sent: the same stages score them in this process, without a bus and without a restart.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fantwin.pipeline.recordings.parts import in_order
from fantwin.pipeline.replay.offline.alarm_episodes import Episode, episodes
from fantwin.pipeline.replay.offline.offline_pipeline import OfflinePipeline
from fantwin.pipeline.replay.offline.plan import undisturbed_plan
from fantwin.pipeline.replay.offline.raw_blocks import RawBlocks
from fantwin.pipeline.replay.offline.replay_input import ReplayInput, open_replay_input
from fantwin.schemas.codec import decode
from fantwin.schemas.enums import Transition
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Alarm, Message, Raw, Score
from fantwin.schemas.topics import tray_key
from fantwin.schemas.units import NS_PER_S

RECORDS_SCORES = '[recorder]\ntopics = ["raw", "score"]\n'
"""section of a configuration: what an outcome is read from"""


@dataclass
class Outcome:
    """What is in the recordings, beside what was sent and what should have been decided."""

    sent: int = 0
    """raw messages"""
    not_recorded: int = 0
    """of these"""
    scored: int = 0
    """samples that should have a score"""
    not_scored: int = 0
    """of these, without one in the recordings"""
    counted: int = 0
    """messages that the site has counted as lost"""
    alarms: int = 0
    """that should have been raised and cleared"""
    forgotten: list[Episode] = field(default_factory=list)
    """those that are not recorded so"""
    too_many: list[Episode] = field(default_factory=list)
    """alarms that are recorded and should not be"""
    raised_again: list[tuple[str, int, int]] = field(default_factory=list)
    """tray, fan and onset of alarms that were raised more than once"""
    moved_s: float = 0.0
    """the most by which the beginning or the end of an alarm has moved"""

    @property
    def lost_silently(self) -> bool:
        """Whether something is missing, and the site has not counted anything."""
        return bool(self.not_recorded or self.not_scored) and not self.counted

    @property
    def alarms_are_right(self) -> bool:
        """Whether they are those of a site that was left alone."""
        return not (self.forgotten or self.too_many or self.raised_again)

    def row(self) -> dict[str, float]:
        """For a table."""
        return {
            "raw sent": self.sent,
            "not recorded": self.not_recorded,
            "samples": self.scored,
            "not scored": self.not_scored,
            "counted": self.counted,
            "alarms": self.alarms,
            "forgotten": len(self.forgotten),
            "too many": len(self.too_many),
            "raised again": len(self.raised_again),
            "moved by s": self.moved_s,
        }

    def notes(self) -> list[str]:
        """A line for each alarm that is not as it should be."""
        lines = [f"forgotten: {_in_words(each)}" for each in self.forgotten]
        return lines + [f"too many: {_in_words(each)}" for each in self.too_many]


def outcome_of(
    folders: Iterable[Path], sent: Mapping[str, Sequence[Raw]], lost: Mapping[str, int], may_move_s: float
) -> Outcome:
    """The outcome by the recordings in some run folders.

    lost: by process, as `fantwin up` counts. may_move_s: by which the beginning and the end of an alarm may move.
    """
    found = Outcome(counted=sum(lost.values()))
    with open_replay_input(in_order(folders), None, (), None) as recorded:
        for tray, raws in sent.items():
            found.sent += len(raws)
            had = {decode(Raw, each.payload).header.sequence for each in recorded.envelopes(tray, ("raw",))}
            found.not_recorded += len(raws) - len(had)
            _compare(recorded, tray, raws, found, round(may_move_s * NS_PER_S))
    return found


def _compare(recorded: ReplayInput, tray: str, raws: Sequence[Raw], found: Outcome, may_move_ns: int) -> None:
    should, times = _left_alone(recorded, tray, raws)
    of_scores = (decode(Score, each.payload).t_ns for each in recorded.envelopes(tray, ("score",)))
    scored = np.unique(np.concatenate([np.empty(0, np.int64), *of_scores]))
    found.scored += len(times)
    found.not_scored += len(np.setdiff1d(times, scored))
    _, alarms, _ = recorded.read_plan(tray)
    has = episodes(alarms)
    found.alarms += len(should)
    for each in should:
        same = [other for other in has if (moved_ns := _moved_ns(each, other)) is not None and moved_ns <= may_move_ns]
        if same:
            has.remove(same[0])
            found.moved_s = max(found.moved_s, (_moved_ns(each, same[0]) or 0) / NS_PER_S)
        else:
            found.forgotten.append(each)
    found.too_many += has
    raised = Counter((tray, each.fan, each.onset_t_ns) for each in alarms if each.transition == Transition.RAISED)
    found.raised_again += [alarm for alarm, count in raised.items() if count > 1]


def _left_alone(recorded: ReplayInput, tray: str, raws: Sequence[Raw]) -> tuple[list[Episode], NDArray[np.int64]]:
    """The alarms of the samples that were sent, and the times of the samples (n,) that get a score."""
    key = tray_key(recorded.config.site, tray, "raw")
    blocks = RawBlocks(lambda: (Envelope.of(key, raw, int(raw.host_receive_t_ns[-1])) for raw in raws), _ignore)
    contexts = recorded.contexts(recorded.config.tray(tray))
    pipeline = OfflinePipeline(recorded.stages, contexts, blocks, undisturbed_plan(recorded.stages), _ignore)
    made = [message for _, message in pipeline.run()]
    alarms = [replace(each, header=Header("left alone", 0, tray)) for each in made if isinstance(each, Alarm)]
    times = [each.t_ns for each in made if isinstance(each, Score)]
    return episodes(alarms), np.unique(np.concatenate([np.empty(0, np.int64), *times]))


def _ignore(_message: Message) -> None:
    pass


def _moved_ns(one: Episode, other: Episode) -> int | None:
    """How far the times of an alarm differ; None if they are different ones."""
    if (one.tray, one.fan) != (other.tray, other.fan) or (one.cleared_ns is None) != (other.cleared_ns is None):
        return None
    return max(abs(one.onset_ns - other.onset_ns), abs((one.cleared_ns or 0) - (other.cleared_ns or 0)))


def _in_words(episode: Episode) -> str:
    cleared = "never cleared" if episode.cleared_ns is None else f"cleared at {episode.cleared_ns}"
    return f"{episode.tray}, fan {episode.fan}: from {episode.onset_ns}, {cleared}"
