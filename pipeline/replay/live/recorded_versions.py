"""The learned versions of a recording's twins, published again for stages that judge the replay.

The integrator of a recorded site said on topic `twin` which version it had changed to, and at which sample. A replay
turns this into messages of topic `new_twin`, as the learner sends them, which also name that sample.

A message must arrive before its sample, and from `raw` that comes by way of the resampler. So each version is published
in advance: as soon as the one before it takes over. What the replay keeps for stages that start later is then the
version in force and the next one.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from fantwin.pipeline.recordings.order import Seen
from fantwin.pipeline.recordings.rare_messages import rare_messages
from fantwin.pipeline.replay.live.sample_times import sample_times
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.messages import ModelCard, NewTwin
from fantwin.schemas.topics import tray_of

TWIN, NEW_TWIN = "twin", "new_twin"


@dataclass(frozen=True)
class Version:
    """A learned twin, and the time of the first sample that it predicts."""

    card: ModelCard
    first_t_ns: int


def read_versions(files: Iterable[Path]) -> dict[str, list[Version]]:
    """The versions of each tray in the order they took over; files: the parts of a recording in order.

    Raises:
        RecordingError: a file cannot be read.
    """
    seen: dict[tuple[str, str], Seen] = {}
    producers: dict[str, str] = {}
    versions: dict[str, list[Version]] = {}
    for entry in (entry for file in files for entry in rare_messages(file, TWIN)):
        card = entry.message
        assert isinstance(card, ModelCard)
        tray, header = tray_of(entry.key), card.header
        if not card.content or not seen.setdefault((entry.key, header.producer), Seen()).is_new(header.sequence):
            continue
        known = versions.setdefault(tray, [])
        before, producers[tray] = producers.get(tray, header.producer), header.producer
        if known and known[-1].card.sha256 == card.sha256:
            continue
        first_t_ns = card.t_ns
        if before != header.producer:
            # An integrator that was restarted predicts old samples again. The version is new for those after its start.
            first_t_ns = max(first_t_ns, entry.received_t_ns)
        known.append(Version(card, max(first_t_ns, known[-1].first_t_ns) if known else first_t_ns))
    return versions


class ComingVersions:
    """The versions that one round of a replay has still to publish."""

    def __init__(
        self, versions: Mapping[str, Sequence[Version]], end_ns: int | None = None, *, is_first_round: bool = True
    ) -> None:
        """end_ns: later versions do not take over in this round; None: all do."""
        self._coming = {
            tray: [each for each in of_tray if end_ns is None or each.first_t_ns <= end_ns]
            for tray, of_tray in versions.items()
        }
        self._is_first_round = is_first_round
        self._begin_ns: dict[str, int] = {}
        """by tray: time of its first sample in this round"""
        self._published_until_ns: dict[str, int] = {}
        """by tray: when the newest version that was published takes over"""

    def before(self, entry: Envelope) -> Iterator[Envelope]:
        """What is to be published before a message: at the first samples of a tray the version then in force; then
        each version as soon as the one before it takes over."""
        tray = tray_of(entry.key)
        coming, times = self._coming.get(tray), sample_times(entry.message)
        if not coming or not len(times):
            return
        oldest_ns, newest_ns = int(times[0]), int(times[-1])
        begin_ns = self._begin_ns.setdefault(tray, oldest_ns)
        while len(coming) > 1 and coming[1].first_t_ns <= begin_ns:
            del coming[0]
        while coming and self._published_until_ns.get(tray, oldest_ns) <= newest_ns:
            version = coming.pop(0)
            first_t_ns = version.first_t_ns
            if not self._is_first_round:
                # Not at samples of the round before. In the first round there are none; its grid may begin a little
                # before its first raw sample.
                first_t_ns = max(first_t_ns, begin_ns)
            self._published_until_ns[tray] = first_t_ns
            yield _message(entry, version.card, oldest_ns, first_t_ns)


def _message(entry: Envelope, card: ModelCard, t_ns: int, first_t_ns: int) -> Envelope:
    key = entry.key.rpartition("/")[0] + f"/{NEW_TWIN}"
    message = NewTwin(t_ns=t_ns, twin=card.twin, sha256=card.sha256, content=card.content, first_sample_t_ns=first_t_ns)
    return Envelope.of(key, message, entry.received_t_ns)
