"""The versions of a learned twin: a folder with an ONNX file for each, and a list that says how each came about.

FOLDER/versions.json   the list, and which version is in force; replaced as a whole
FOLDER/TRAY-1.onnx     the first version, and so on
"""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Literal, TypeAlias

from pydantic import BaseModel, ConfigDict, ValidationError

from pipeline.errors import UserError

LIST_NAME = "versions.json"
Outcome: TypeAlias = Literal["taken", "offered"]
Period: TypeAlias = tuple[int, int]
"""first and last time, ns since 1970"""


class _Record(BaseModel):
    model_config = ConfigDict(frozen=True, extra="ignore")  # of a newer fantwin, as after an update that is undone


class Drop(_Record):
    """What the limits find at a speed: the smallest drop that raises an alarm, of the fan with the widest limits.

    In the unit of the tray; None where not even standstill raises one.
    """

    speed: float
    at_once: float | None
    within_a_minute: float | None


class Version(_Record):
    """One version, and why it took over or did not.

    made_t_ns: the newest sample that it was learned from. hours: healthy running from which its limits were set.
    periods: of the recordings from which it was learned. since_t_ns: earlier recordings are not used, because the fans
    have changed since. error: of the free run over the newest recording, root mean square over all fans. reference: the
    version against which changes of the fans' speeds are measured, the first one learned from 24 hours. change: of each
    fan, how its speed in the newest recording differs from the reference's prediction, as a share. declared_per_day:
    false alarms of a fan that the limits are for; is_target: the data are too few to show that they keep it. Speeds are
    in the unit of the tray.
    """

    name: str
    how: Literal["trained", "new limits"]
    made_t_ns: int
    hours: float
    periods: tuple[Period, ...]
    since_t_ns: int
    speed_unit: str
    error: float
    change: tuple[float, ...]
    reference: str
    drops: tuple[Drop, ...]
    declared_per_day: float
    is_target: bool
    outcome: Outcome
    why: str
    sha256: str


class _List(_Record):
    in_force: str = ""
    is_chosen: bool = False
    """an operator has put it in force"""
    versions: tuple[Version, ...] = ()
    faulty: tuple[Period, ...] = ()


class TwinVersions:
    """The versions of one tray's twin. Every method reads the list again: others may have changed it."""

    def __init__(self, folder: Path, tray: str) -> None:
        self.folder = folder
        self._tray = tray
        self._path = folder / LIST_NAME

    @property
    def change_id(self) -> int:
        """A value that changes with each change of the list; 0 if there is no list."""
        try:
            status = self._path.stat()
        except OSError:
            return 0
        return status.st_mtime_ns ^ status.st_ino

    def all(self) -> tuple[Version, ...]:
        """All versions, in the order they were made.

        Raises:
            UserError: the list cannot be read.
        """
        return self._read().versions

    def in_force(self) -> Version | None:
        """The version in force, if there is one. Raises as `all`."""
        listed = self._read()
        return next((version for version in listed.versions if version.name == listed.in_force), None)

    def is_chosen(self) -> bool:
        """Whether an operator has put the version in force, also by calling a time faulty. Raises as `all`."""
        return self._read().is_chosen

    def faulty(self) -> tuple[Period, ...]:
        """The periods that operators called faulty. Raises as `all`."""
        return self._read().faulty

    def not_learned(self) -> tuple[Period, ...]:
        """The periods that are not learned from: faulty ones, those before the fans changed for the version in force,
        and those of offered versions, which show another change. Raises as `all`."""
        listed = self._read()
        now = next((version for version in listed.versions if version.name == listed.in_force), None)
        since_t_ns = now.since_t_ns if now else 0
        offered = [v for v in listed.versions if v.outcome == "offered" and v.since_t_ns != since_t_ns]
        periods = (period for version in offered for period in version.periods)
        return (*listed.faulty, *periods, (0, since_t_ns - 1))

    def next_name(self) -> str:
        """The name of the next version. Raises as `all`."""
        return f"{self._tray}-{len(self._read().versions) + 1}"

    def file(self, name: str) -> Path:
        """The ONNX file of a version."""
        return self.folder / f"{name}.onnx"

    def add(self, version: Version) -> None:
        """Add a version, whose file is there; if it was taken, it is in force now.

        Raises:
            UserError: the list cannot be read or written.
        """
        with self._changing() as listed:
            taken = {"in_force": version.name, "is_chosen": False} if version.outcome == "taken" else {}
            self._write(listed.model_copy(update={**taken, "versions": (*listed.versions, version)}))

    def use(self, name: str) -> None:
        """Put a version in force, an earlier one or one that is offered.

        Raises:
            UserError: there is no such version; or as `add`.
        """
        with self._changing() as listed:
            names = [version.name for version in listed.versions]
            if name not in names:
                raise UserError(f"{self.folder}: no version {name!r}; there are {', '.join(names) or 'none yet'}")
            self._write(listed.model_copy(update={"in_force": name, "is_chosen": True}))

    def call_faulty(self, period: Period) -> tuple[str, str]:
        """Never learn from a period. A twin in force that did is replaced by the newest taken version that did not.

        Returns:
            the version that was in force and the one that is now; both empty where the one in force did not learn from
            the period, the second empty where there is no other version.

        Raises:
            UserError: as `add`.
        """
        with self._changing() as listed:
            tainted = {version.name for version in listed.versions if overlaps(version.periods, [period])}
            clean = [v.name for v in listed.versions if v.outcome == "taken" and v.name not in tainted]
            was, now = (listed.in_force, clean[-1] if clean else "") if listed.in_force in tainted else ("", "")
            update = {"faulty": (*listed.faulty, period), "in_force": now or listed.in_force}
            update["is_chosen"] = bool(now) or listed.is_chosen
            self._write(listed.model_copy(update=update))
        return was, now

    def _read(self) -> _List:
        try:
            return _List.model_validate_json(self._path.read_bytes())
        except FileNotFoundError:
            return _List()
        except (OSError, ValidationError) as error:
            why = error.strerror if isinstance(error, OSError) else f"{error.errors()[0]['msg']}"
            raise UserError(f"{self._path}: cannot read the versions of the twin: {why}; move it away") from error

    @contextmanager
    def _changing(self) -> Iterator[_List]:
        """The list, while no other process changes it."""
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            descriptor = os.open(self.folder / f"{LIST_NAME}.lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        except OSError as error:
            raise self._cannot_write(error) from error
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX)
            yield self._read()
        finally:
            os.close(descriptor)

    def _write(self, listed: _List) -> None:
        unfinished = self._path.with_suffix(".new")
        try:
            with unfinished.open("w", encoding="utf-8") as file:
                file.write(listed.model_dump_json(indent=1))
                file.flush()
                os.fsync(file.fileno())
            unfinished.replace(self._path)
        except OSError as error:
            raise self._cannot_write(error) from error

    def _cannot_write(self, error: OSError) -> UserError:
        return UserError(f"{self._path}: cannot write the versions of the twin: {error.strerror}")


def learning_folder(run_folder: Path, tray: str) -> Path:
    """Where the healthy history of a tray is kept, and the versions of its twin."""
    return run_folder / "learned" / tray


def overlaps(periods: Sequence[Period], others: Sequence[Period]) -> bool:
    """Whether any of the periods has a moment in common with any of the others."""
    return any(first <= until and since <= last for first, last in periods for since, until in others)
