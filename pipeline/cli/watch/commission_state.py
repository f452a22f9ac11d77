"""A `fantwin commission` as other commands and the next one see it: what it does now, and what it has recorded."""

from __future__ import annotations

import fcntl
import json
import time
from contextlib import suppress
from pathlib import Path
from typing import Self

from pydantic import BaseModel, ValidationError

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.files import write_whole
from fantwin.pipeline.recordings.disk import is_being_written

RECORDING_ONLY = (
    *("--set", f"launcher.stages={json.dumps(['acquisition', 'resampler', 'recorder'])}"),
    *("--set", "launcher.without=[]"),
    *("--set", "launcher.shards={ recorder = 1 }"),
    *("--set", "recorder.keep_days=0"),
    *("--set", "recorder.keep_share_of_disk=1"),
)
"""the options of a site that only records: all trays in one recording, however much it takes of the disk"""
LOG = "commission.log"
"""what the `up` that records says; locked while a commissioning runs, so that its end shows however it ends"""
_FILE = "commission.json"
FRESH_S = 86_400.0
"""older recordings are not used again: meanwhile a fan may have been exchanged, or have failed"""


class TraySoFar(BaseModel):
    """What has been recorded of a tray that has no twin yet."""

    made_by: str = ""
    """the settings and options with which it was recorded"""
    t_s: float = 0.0
    """when the last recording ended, seconds since 1970"""
    recorded: dict[str, list[Path]] = {}
    """the parts of the recording for each purpose"""
    held: list[str] = []
    """fans that hardly moved while the data for their limits were recorded"""

    @property
    def files(self) -> list[Path]:
        """Those of all purposes."""
        return [path for paths in self.recorded.values() for path in paths]


class _SoFar(BaseModel):
    doing: str = "begins"
    trays: dict[str, TraySoFar] = {}


class Unfinished:
    """What the commissioning of this process has done until now. A context manager."""

    def __init__(self, folder: Path) -> None:
        """Raises UserError: another one runs with this run folder, or it cannot be written."""
        self.file = folder / _FILE
        if is_being_written(folder / LOG):
            raise UserError(f"another `fantwin commission` runs with run folder {folder}: wait, or end it with Ctrl-C")
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._lock = (folder / LOG).open("a", encoding="utf-8")
        except OSError as error:
            raise UserError(f"{folder}: cannot be written: {error.strerror}; choose another run_folder") from error
        fcntl.flock(self._lock, fcntl.LOCK_EX)
        self._so_far = _read(folder)
        self.show("begins")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        if not self._so_far.trays:
            self.file.unlink(missing_ok=True)
        self._lock.close()

    def show(self, doing: str) -> None:
        """Let `fantwin status` say what is being done."""
        self._so_far.doing = doing
        write_whole(self.file, self._so_far.model_dump_json(indent=1).encode(), "")

    def of(self, tray: str, made_by: str) -> TraySoFar:
        """What an earlier one has recorded of a tray in the same way, in the last day; nothing if a part is gone."""
        found = self._so_far.trays.get(tray)
        is_same = found and found.made_by == made_by and time.time() - found.t_s < FRESH_S
        return found if found and is_same and all(path.exists() for path in found.files) else TraySoFar(made_by=made_by)

    def keep(self, tray: str, so_far: TraySoFar) -> None:
        """Keep what has been recorded of a tray until now for the next one."""
        recorded = {purpose: [path.resolve() for path in paths] for purpose, paths in so_far.recorded.items()}
        self._so_far.trays[tray] = so_far.model_copy(update={"recorded": recorded, "t_s": time.time()})
        self.show(self._so_far.doing)

    def has(self, tray: str) -> bool:
        """Whether something is kept of a tray."""
        return tray in self._so_far.trays

    def forget(self, tray: str) -> None:
        """Let the next one begin with a tray again."""
        self._so_far.trays.pop(tray, None)
        self.show(self._so_far.doing)


def commissioning_now(folder: Path) -> str:
    """What a commissioning with this run folder does now; empty if none runs."""
    return _read(folder).doing if is_being_written(folder / LOG) else ""


def _read(folder: Path) -> _SoFar:
    with suppress(OSError, ValidationError):
        return _SoFar.model_validate_json((folder / _FILE).read_bytes())
    return _SoFar()
