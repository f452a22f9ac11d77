"""Healthy recordings as the scorer would be fed them: what alarms are calibrated on."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.errors import UserError
from pipeline.replay.offline.replay_input import open_replay_input
from pipeline.runtime.tray_twin import load_tray_twin
from schemas.codec import CodecError
from scoring.calibration.healthy_statistics import Running
from scoring.fan_scorer import Samples, samples_of
from scoring.limits import Timing

KEPT_SAMPLES = 10_000_000
"""of fans, about 80 bytes each: so many are kept between passes, what is beyond is made anew"""


@dataclass(frozen=True)
class HealthyRun:
    """One tray of one recording."""

    path: Path
    tray: str
    fans: int


class HealthyRuns:
    """Recordings, each judged from its start as a live tray is; to be gone through several times."""

    def __init__(
        self, paths: Sequence[Path], twin: Path, overrides: Sequence[str], progress: Callable[[str], None]
    ) -> None:
        self._paths = paths
        self._twin = twin
        self._overrides = overrides
        self._progress = progress
        self._knows_fans = load_tray_twin(twin).fans > 1
        self._pass = 0
        self._kept: list[Running] | None = None
        self.runs: list[HealthyRun] = []

    def __call__(self) -> Iterator[Running]:
        """All runs from the beginning.

        Raises:
            UserError: a recording cannot be used.
        """
        self._pass += 1
        if self._kept is not None:
            yield from self._kept
            return
        self.runs = []
        kept = _Kept()
        for path in self._paths:
            self._progress(f"pass {self._pass}: {path}")
            try:
                for run, blocks in self._of(path):
                    self.runs.append(run)
                    known_as = range(run.fans) if self._knows_fans else None
                    yield kept.noting(Running(run.fans, blocks, known_as))
            except CodecError as error:
                raise UserError(f"{path}: a message cannot be decoded: {error}; see `fantwin info`") from error
        self._kept = kept.whole

    def timing(self) -> Timing:
        """The times of the scorer, as the recordings' configuration has them, and the keys set on top.

        Raises:
            UserError: a recording cannot be used, or they are not the same for all.
        """
        found: dict[Timing, Path] = {}
        for path in self._paths:
            with open_replay_input([path], None, self._overrides, self._twin) as material:
                scorer: Any = material.config.sections["scorer"]
                found.setdefault(scorer.timing(Timing()), path)
        first, *others = found
        for other in others:
            names = [name for name in Timing.model_fields if getattr(first, name) != getattr(other, name)]
            raise UserError(
                f"{found[first]} and {found[other]} differ in scorer.{names[0]}, for which limits are found: "
                "say which with --set"
            )
        return first

    def _of(self, path: Path) -> Iterator[tuple[HealthyRun, Iterator[Samples]]]:
        with open_replay_input([path], None, self._overrides, self._twin) as material:
            for tray in material.trays:
                name = tray.name
                yield HealthyRun(path, name, tray.fans), map(samples_of, material.pipeline(name).predictions())


class _Kept:
    """The blocks of all runs, as long as there is room for them. runs: None once there was none."""

    def __init__(self) -> None:
        self.runs: list[Running] | None = []
        self._room = KEPT_SAMPLES
        self._begun = 0

    @property
    def whole(self) -> list[Running] | None:
        """The runs, if there was room and every one was gone through to its end."""
        return None if self._begun else self.runs

    def noting(self, run: Running) -> Running:
        """The next run, whose blocks are noted as they go by."""
        mine: list[Samples] = []
        if self.runs is not None:
            self.runs.append(run._replace(blocks=mine))
        return run._replace(blocks=self._noted(run.blocks, mine))

    def _noted(self, blocks: Iterable[Samples], mine: list[Samples]) -> Iterator[Samples]:
        self._begun += 1
        for block in blocks:
            self._room -= block.speed_rad_s.size
            if self._room < 0:
                self.runs = None
                mine.clear()
            else:
                mine.append(block)
            yield block
        self._begun -= 1
