"""Recordings and twins that several tests need, made once a session: the workers of xdist share a folder."""

from __future__ import annotations

import fcntl
import hashlib
import pickle
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from fantwin.twin.build import train_twin
from fantwin.twin.finishing import TrainedTwin
from fantwin.twin.runs import Run


class MadeOnce:
    """Folders by their names, each filled by the worker that needs it first. Tests must not change what is in them."""

    def __init__(self, place: Path) -> None:
        self._place = place

    def __call__(self, name: str, make: Callable[[Path], None]) -> Path:
        folder, done = self._place / name, self._place / f"{name}.done"
        with (self._place / f"{name}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not done.exists():
                folder.mkdir(exist_ok=True)
                make(folder)
                done.touch()
        return folder


class TrainedOnce:
    """`train_twin`, whose results are kept by the hash of what they were made of."""

    def __init__(self, made_once: MadeOnce) -> None:
        self._made_once = made_once

    def __call__(self, runs: Sequence[Run], held_out: Sequence[Run], kind: str, **settings: Any) -> TrainedTwin:
        """The twin of these runs. Tests must not change it."""
        key = hashlib.sha256(pickle.dumps((tuple(runs), tuple(held_out), kind, sorted(settings.items())))).hexdigest()

        def make(folder: Path) -> None:
            (folder / "twin").write_bytes(pickle.dumps(train_twin(runs, held_out, kind, **settings)))

        return pickle.loads((self._made_once(f"twin-{key[:24]}", make) / "twin").read_bytes())
