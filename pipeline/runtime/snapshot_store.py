"""Where a stage keeps what it must not forget: one small file, replaced as a whole."""

from __future__ import annotations

import os
from pathlib import Path

from pipeline.runtime.stage import StageError
from schemas.codec import CodecError, decode, encode
from schemas.messages import ScorerSnapshot


class SnapshotStore:
    """One file. A kill at any moment leaves the old one or the new one, never half of either."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.problem = ""
        """one line, while the last note could not be written"""

    def load(self) -> ScorerSnapshot | None:
        """What was kept last; None when there is nothing.

        Raises:
            StageError: there is something, and it cannot be read.
        """
        try:
            message = decode(ScorerSnapshot, self.path.read_bytes())
        except FileNotFoundError:
            return None
        except OSError as error:
            raise StageError(f"{self.path}: cannot read what the scorer knew: {error.strerror}") from error
        except CodecError as error:
            raise StageError(
                f"{self.path}: not what a scorer kept ({error}); remove it to begin anew: fans are commissioned again"
            ) from error
        assert isinstance(message, ScorerSnapshot)
        return message

    def keep(self, snapshot: ScorerSnapshot) -> None:
        """Replace what is kept. A full disk is told and does not stop the scorer."""
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            beside = self.path.with_suffix(".new")
            with beside.open("wb") as file:
                file.write(encode(snapshot))
                file.flush()
                os.fsync(file.fileno())
            beside.replace(self.path)
            self.problem = ""
        except OSError as error:
            self.problem = (
                f"{self.path}: cannot keep baselines and alarms: {error.strerror}; a restart would forget them"
            )
