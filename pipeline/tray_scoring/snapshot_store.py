"""Where a stage keeps the state that survives a restart: one small file, replaced as a whole.

The file may be missing, or old, where the stage ran on another host since. So what other stages keep is looked at as
well, and the newest snapshot counts.
"""

from __future__ import annotations

import fcntl
import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

from fantwin.pipeline.files import replace_file
from fantwin.pipeline.runtime.stage import StageError
from fantwin.schemas.codec import CodecError, decode, encode
from fantwin.schemas.formats import SNAPSHOT
from fantwin.schemas.messages import ScorerSnapshot
from fantwin.schemas.units import NS_PER_S

RECENT_NS = 120 * NS_PER_S
"""a file that is no older, two periods of snapshots, is that of the last session, unless somebody knows a newer one"""
AHEAD_NS = NS_PER_S
"""a snapshot that is further ahead of the present is of a clock that was wrong"""
Elsewhere = Callable[[bool], tuple[Sequence[ScorerSnapshot], str]]
"""the snapshots that others keep, and why there may be more; given whether to wait for those who are not there yet"""


class SnapshotStore:
    """One file. A kill at any moment leaves the old file or the new one, never a part of either."""

    def __init__(self, path: Path, elsewhere: Elsewhere | None = None, now_ns: int = 0) -> None:
        """elsewhere: asked once, by the first `load`; None: nobody is. now_ns: the present time."""
        self.path = path
        self.note = ""
        """one line, if `load` has found a newer snapshot than that of the file, or may have missed one"""
        self._elsewhere = elsewhere
        self._kept: Sequence[ScorerSnapshot] = ()
        self._is_asked = False
        self._now_ns = now_ns
        self._lock: int | None = None
        self.problem = ""
        """one line, while the last snapshot could not be saved"""

    def lock(self, user: str) -> None:
        """Keep other processes from using the snapshot until `unlock`, or until this process ends, however it ends.

        user: who this is, for whoever is refused. Where no file can be written, nothing is locked: nothing can be saved
        there either, which `save` reports.

        Raises:
            StageError: another process uses it.
        """
        path = self.path.with_suffix(".lock")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        except OSError:
            return
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            other = os.read(descriptor, 200).decode(errors="replace")
            os.close(descriptor)
            raise StageError(
                f"{self.path}: in use by another scorer ({other}); stop that, or give this site another run_folder"
            ) from error
        self._lock = descriptor
        with suppress(OSError):  # a full disk: locked all the same
            os.truncate(descriptor, 0)
            os.write(descriptor, f"process {os.getpid()}, {user}".encode())

    def unlock(self) -> None:
        """Let other processes use the snapshot."""
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def load(self) -> ScorerSnapshot | None:
        """The last snapshot, of the file or of those that others keep; None when there is none.

        The last one counts also if it is of another twin: what operators have set since must not be forgotten.

        Raises:
            StageError: the file cannot be read or has an unknown format, or what others keep is of a newer version.
        """
        own = self._read()
        if self._elsewhere is None:
            return own
        if not self._is_asked:
            is_recent = own is not None and own.t_ns > self._now_ns - RECENT_NS
            self._kept, why = self._elsewhere(not is_recent)
            self._is_asked = True
            from_what = "from the file here" if own else "without a snapshot"
            self.note = f"continued {from_what}: {why}" if why else ""
        newest_known = max(SNAPSHOT.read)
        kept = [each for each in self._kept if each.format in SNAPSHOT.read or each.format > newest_known]
        if self._kept and not kept:
            self.note = "what the recorder keeps is of an older version of fantwin, and was left out"
        found = [*([own] if own else []), *kept]
        last = max(found, key=lambda each: (each.t_ns <= self._now_ns + AHEAD_NS, each.t_ns), default=None)
        if last is not None and last is not own:
            self.note = f"continued from the snapshot that the recorder keeps; {_beside(last, own)}"
            _check_format(last, f"{self.path.stem}: the snapshot that the recorder keeps")
        return last

    def _read(self) -> ScorerSnapshot | None:
        try:
            own = decode(ScorerSnapshot, self.path.read_bytes())
        except FileNotFoundError:
            return None
        except OSError as error:
            raise StageError(f"{self.path}: cannot read the scorer's snapshot: {error.strerror}") from error
        except CodecError as error:
            start = "continue from the one that the recorder keeps, or" if self._elsewhere else "start"
            raise StageError(
                f"{self.path}: not a scorer's snapshot ({error}); remove it to {start} without one: what was "
                "learned of the fans, alarms and wear then begin again"
            ) from error
        _check_format(own, str(self.path))
        return own

    def save(self, snapshot: ScorerSnapshot) -> None:
        """Replace the snapshot. A full disk is reported in `problem` and does not stop the scorer."""
        try:
            replace_file(self.path, encode(snapshot))
            self.problem = ""
        except OSError as error:
            self.problem = (
                f"{self.path}: cannot save what was learned of the fans, nor alarms: {error.strerror}; a restart would "
                "forget them"
            )


def _beside(last: ScorerSnapshot, own: ScorerSnapshot | None) -> str:
    if own is None:
        return "there is none here"
    older_s = (last.t_ns - own.t_ns) / NS_PER_S
    if older_s < 0:
        return f"the file here is {-older_s:.0f} s newer, because the clock was ahead when it was written"
    return f"the file here is {older_s:.0f} s older"


def _check_format(snapshot: ScorerSnapshot, where: str) -> None:
    if refusal := SNAPSHOT.refusal(snapshot.format or None):
        raise StageError(f"{where}: {refusal}")
