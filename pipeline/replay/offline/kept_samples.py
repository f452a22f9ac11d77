"""Samples that were computed from recordings, kept on the disk of this host while they are gone through several times.

Computing them again takes about twice as long as scoring them. Another host of a cluster does not see the folder, and
computes them again.
"""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from scoring.samples import Samples


@dataclass(frozen=True)
class RecordedTray:
    """One tray of one recording."""

    path: Path
    tray: str
    fans: int


TrayRuns = Iterable[tuple[RecordedTray, Iterable[Samples]]]
"""The trays of a recording, each with its blocks of samples, which are read in turn."""


@dataclass(frozen=True)
class KeptSamples:
    """A folder of samples. The process that makes it also deletes it."""

    folder: Path
    room: int
    """samples of fans, about 85 bytes each, that are kept of one recording: none of a longer one, or on a full disk"""

    def of(self, recording: Path) -> TrayRuns | None:
        """The runs of a recording that has been read to its end; None where they are not kept."""
        try:
            trays: list[RecordedTray] = pickle.loads(self._index(recording).read_bytes())
        except FileNotFoundError:
            return None
        return [(tray, _blocks_in(self._blocks(recording, number))) for number, tray in enumerate(trays)] or None

    def keep(self, recording: Path, runs: TrayRuns) -> TrayRuns:
        """The same runs, whose blocks are written down as they are read."""
        if not self.folder.is_dir() or self._index(recording).exists():  # another host, or too long
            return runs
        return self._written(recording, runs)

    def _written(self, recording: Path, runs: TrayRuns) -> TrayRuns:
        trays: list[RecordedTray] = []
        room, unfinished = self.room, 0

        def written(blocks: Iterable[Samples], path: Path) -> Iterator[Samples]:
            nonlocal room, unfinished
            unfinished += 1
            path.unlink(missing_ok=True)  # of a pass that ended early
            for block in blocks:
                room -= block.speed_rad_s.size
                if room < 0 or not _appended(block, path):
                    room = -1
                    path.unlink(missing_ok=True)
                yield block
            unfinished -= 1

        for number, (tray, blocks) in enumerate(runs):
            trays.append(tray)
            yield tray, written(blocks, self._blocks(recording, number))
        complete = self.folder / f"{self._name(recording)}.new"
        if not unfinished and _appended(trays if room >= 0 else [], complete):
            complete.rename(self._index(recording))

    def _index(self, recording: Path) -> Path:
        """Lists the trays of a recording; none if its samples are not kept."""
        return self.folder / f"{self._name(recording)}.trays"

    def _blocks(self, recording: Path, number: int) -> Path:
        return self.folder / f"{self._name(recording)}.{number}"

    @staticmethod
    def _name(recording: Path) -> str:
        return hashlib.sha256(str(recording).encode()).hexdigest()


def _appended(content: object, path: Path) -> bool:
    """Whether the disk took it. What is kept only saves time, so it may refuse."""
    try:
        with path.open("ab") as file:
            pickle.dump(content, file)
    except OSError:
        return False
    return True


def _blocks_in(path: Path) -> Iterator[Samples]:
    with path.open("rb") as file:
        while True:
            try:
                block: Samples = pickle.load(file)
            except EOFError:
                return
            yield block
