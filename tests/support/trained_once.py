"""Twins that several tests need, trained once a session: the workers of xdist share a folder."""

from __future__ import annotations

import fcntl
import hashlib
import pickle
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from fantwin.twin.build import train_twin
from fantwin.twin.finishing import TrainedTwin
from fantwin.twin.runs import Run


class TrainedOnce:
    """`train_twin`, whose results are kept in a folder by the hash of what they were made of."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def __call__(self, runs: Sequence[Run], held_out: Sequence[Run], kind: str, **settings: Any) -> TrainedTwin:
        """The twin of these runs. Tests must not change it."""
        key = hashlib.sha256(pickle.dumps((tuple(runs), tuple(held_out), kind, sorted(settings.items())))).hexdigest()
        file = self._folder / f"{key[:24]}.pickle"
        with file.with_suffix(".lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not file.exists():
                file.write_bytes(pickle.dumps(train_twin(runs, held_out, kind, **settings)))
        return pickle.loads(file.read_bytes())
