"""The versions of a learned twin: a folder with an ONNX file for each, and a list that says how each came about.

FOLDER/versions.json   the list, and which version is in force; replaced as a whole
FOLDER/TRAY-1.onnx     the first version, and so on
"""

from __future__ import annotations

import fcntl
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Literal, TypeAlias

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.files import replace_file
from fantwin.schemas.units import NS_PER_S

LIST_NAME = "versions.json"
Outcome: TypeAlias = Literal["taken", "offered"]
REFERENCE_S = 24 * 3600.0
"""of healthy running that a reference is learned from; until there is one, every change of speed is taken as healthy"""
TimeSpan: TypeAlias = tuple[int, int]
"""first and last time, ns since 1970"""

DECLARED_PER_DAY = 1.0
"""false alarms of a fan that a learned twin declares: days of healthy running show whether it keeps that rate"""


class _Record(BaseModel):
    # what is extra is of a newer fantwin, as after an update that is undone
    model_config = ConfigDict(frozen=True, extra="ignore", validate_by_name=True, serialize_by_alias=True)


class Drop(_Record):
    """Smallest drops from a speed that raise an alarm within 1, 10 and 60 s, for the fan whose readings vary most; of a
    static twin also within 10 min.

    In the unit of the tray; None where not even standstill raises an alarm.
    """

    speed: float
    within_1_s: float | None
    within_10_s: float | None
    within_60_s: float | None
    within_600_s: float | None = None

    def line(self, unit: str) -> str:
        """One line about the drops, for people."""
        times = ("1 s", "10 s", "60 s", "10 min")
        found = zip((self.within_1_s, self.within_10_s, self.within_60_s, self.within_600_s), times, strict=True)
        parts = [f"{_two_digits(value)} {unit} within {time}" for value, time in found if value is not None]
        drops = f"a drop of {', '.join(parts)}" if parts else "no drop, not even standstill"
        return f"found at {_two_digits(self.speed)} {unit}: {drops}"


def _two_digits(value: float) -> str:
    """The value in whole numbers, or with two digits below 10: a drop needs no more."""
    return f"{value:,.0f}" if value >= 10 else f"{value:.2g}"


class Version(_Record):
    """One version, and why it took over or did not.

    made_t_ns: time of the newest sample that it was learned from. hours: running that its limits were set from, healthy
    but for a version that was learned near alarms, too.
    learned_spans: of the recordings that it was learned from. since_t_ns: recordings from before this time are not
    used, because the fans have changed since. error: root mean square of the free-run residual over a part of the
    newest recording that it was not trained on, all fans together. error_before: the same of the version that was in
    force. reference: the version that changes of the fans are measured against; its own name if there is none yet.
    change: of each fan, its mean speed in the newest hours of healthy running relative to the reference's prediction,
    less one; None where it is not comparable. declared_per_day: false alarms per fan and day that the limits were set
    for; is_target: the data are too few to show that the limits keep it. Speeds are in the unit of the tray.
    """

    name: str
    how: Literal["trained", "new limits"]
    made_t_ns: int
    hours: float
    learned_spans: tuple[TimeSpan, ...] = Field(validation_alias="periods", serialization_alias="periods")
    since_t_ns: int
    speed_unit: str
    error: float
    error_before: float | None = None
    change: tuple[float | None, ...]
    reference: str
    drops: tuple[Drop, ...]
    declared_per_day: float
    is_target: bool
    outcome: Outcome
    why: str
    sha256: str

    @property
    def learned_s(self) -> float:
        """The healthy running that it was learned from."""
        return sum(last - first for first, last in self.learned_spans) / NS_PER_S

    @property
    def rate_text(self) -> str:
        """The false-alarm rate, and whether it is declared, for people."""
        alarms = f"{self.declared_per_day:g} false alarm{'s' * (self.declared_per_day != 1)} per fan and day"
        if self.is_target:
            return f"target: {alarms} ({self.hours:.2g} h of data are too few to declare it)"
        return f"declared: {alarms}"


class Check(_Record):
    """The fans beside the reference.

    t_ns: time of the newest sample of healthy running. near_t_ns: up to then it was seen near alarms, too, whether most
    fans have changed alike; 0: never. reference: empty if there is none yet. change: of each fan, by which share its
    mean speed over the newest hours has changed since the reference was made; None where that cannot be compared.
    found: what has changed more than healthy fans do, in words; empty if nothing has. spans: then those of the
    recordings of healthy running since the last check that found nothing.
    """

    t_ns: int
    reference: str
    change: tuple[float | None, ...]
    found: str
    spans: tuple[TimeSpan, ...]
    near_t_ns: int = 0


class VersionList(_Record):
    """What the list holds."""

    in_force: str = ""
    """name of the version; empty before the first"""
    is_chosen: bool = False
    """an operator has put it in force, also by marking a time span as faulty"""
    versions: tuple[Version, ...] = ()
    """in the order they were made"""
    faulty: tuple[TimeSpan, ...] = ()
    """marked by operators"""
    check: Check | None = None
    """the last one"""
    changed: tuple[tuple[str, TimeSpan], ...] = ()
    """the recordings in which the fans had changed since a reference, with its name"""
    commissioned_t_ns: int = 0
    """when operators last commissioned fans again"""
    published: str = ""
    """the version that the stages had last"""
    alarms_t_ns: tuple[int, ...] = ()
    """when an alarm of a fan began, in the time of the history that is kept"""

    @property
    def current(self) -> Version | None:
        """The version in force, if there is one."""
        return next((version for version in self.versions if version.name == self.in_force), None)

    def with_check(self, check: Check) -> VersionList:
        """The same with another check of the fans."""
        found = ((check.reference, span) for span in check.spans)
        changed = tuple(dict.fromkeys((*self.changed, *found)))
        return self.model_copy(update={"check": check, "changed": changed})

    @property
    def newest_t_ns(self) -> int:
        """When fans were last checked or commissioned, or a version was made."""
        made_t_ns = self.versions[-1].made_t_ns if self.versions else 0
        return max(made_t_ns, self.commissioned_t_ns, self.check.t_ns if self.check else 0)

    @property
    def is_tainted(self) -> bool:
        """Whether the version in force was learned from a time that was marked as faulty."""
        return self.current is not None and overlap(self.current.learned_spans, self.faulty)

    @property
    def excluded_spans(self) -> tuple[TimeSpan, ...]:
        """The time spans that are not learned from: those marked as faulty, those in which the fans had changed since
        the reference of the version in force, and all before the change that this version was learned after."""
        if self.current is None:
            return self.faulty
        changed = (span for reference, span in self.changed if reference == self.current.reference)
        return (*self.faulty, *changed, (0, self.current.since_t_ns - 1))

    def reference_of(self, version: Version) -> Version | None:
        """The reference that the changes of its fans are measured against; None if there was none yet, or it was
        learned from a time that was marked as faulty."""
        named = next((each for each in self.versions if each.name == version.reference), None)
        if named is None or named.learned_s < REFERENCE_S or overlap(named.learned_spans, self.faulty):
            return None
        return named

    @property
    def waiting(self) -> Version | None:
        """The newest version, if it is only offered and the fans are still as they were then."""
        last = self.versions[-1] if self.versions else None
        is_offer = last is not None and last.outcome == "offered" and last.name != self.in_force
        return last if is_offer and self.check and self.check.found else None


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

    def read(self) -> VersionList:
        """The list as it is now.

        Raises:
            UserError: it cannot be read.
        """
        try:
            return VersionList.model_validate_json(self._path.read_bytes())
        except FileNotFoundError:
            return VersionList()
        except (OSError, ValidationError) as error:
            is_bad = isinstance(error, ValidationError)
            why = f"{error.errors()[0]['msg']}; move it away" if is_bad else f"{error.strerror}; see `run_folder`"
            raise UserError(f"{self._path}: cannot read the versions of the twin: {why}") from error

    def all(self) -> tuple[Version, ...]:
        """All versions, in the order they were made. Raises as `read`."""
        return self.read().versions

    def in_force(self) -> Version | None:
        """The version in force, if there is one. Raises as `read`."""
        return self.read().current

    def next_name(self) -> str:
        """The name of the next version; never that of a file that is there. Raises as `read`."""
        number = len(self.all()) + 1
        while self.file(f"{self._tray}-{number}").exists():
            number += 1
        return f"{self._tray}-{number}"

    def file(self, name: str) -> Path:
        """The ONNX file of a version."""
        return self.folder / f"{name}.onnx"

    @contextmanager
    def learning(self) -> Iterator[None]:
        """While a version is made: one at a time.

        Raises:
            UserError: another process makes one, or the folder cannot be written.
        """
        with self._lock_file("learn.lock") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                raise UserError(f"{self.folder}: another `fantwin twins learn` works here: wait for its end") from error
            yield

    def add(self, version: Version, seen: VersionList | None = None, check: Check | None = None) -> None:
        """Add a version, whose file is there; if it was taken, it is in force now.

        seen: the list when it was begun; None: as it is now. check: of the fans, before it was made.

        Raises:
            UserError: operators have put another version in force meanwhile, or marked a time as faulty that it was
                learned from; the list cannot be read or written.
        """
        with self._changing() as listed:
            if seen and listed.in_force != seen.in_force:
                raise UserError(f"{version.name} is not used: {listed.in_force} was put in force while it was made")
            if overlap(version.learned_spans, listed.faulty):
                raise UserError(f"{version.name} is not used: it was learned from a time that is marked as faulty")
            taken = {"in_force": version.name, "is_chosen": False} if version.outcome == "taken" else {}
            now = listed.with_check(check) if check else listed
            self._write(now.model_copy(update={**taken, "versions": (*listed.versions, version)}))

    def add_check(self, check: Check) -> None:
        """Keep a check of the fans against the reference. Raises as `add`."""
        with self._changing() as listed:
            self._write(listed.with_check(check))

    def commission(self, t_ns: int) -> None:
        """Operators commission fans again. Raises as `add`."""
        with self._changing() as listed:
            self._write(listed.model_copy(update={"commissioned_t_ns": t_ns}))

    def publish(self, name: str) -> None:
        """The stages get this version. Raises as `add`."""
        with self._changing() as listed:
            self._write(listed.model_copy(update={"published": name}))

    def add_alarm(self, t_ns: int, forget_before_t_ns: int) -> None:
        """An alarm of a fan began; earlier ones are forgotten. Raises as `add`."""
        with self._changing() as listed:
            kept = (each for each in (*listed.alarms_t_ns, t_ns) if each >= forget_before_t_ns)
            self._write(listed.model_copy(update={"alarms_t_ns": tuple(kept)}))

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

    def mark_faulty(self, span: TimeSpan) -> tuple[str, str]:
        """Mark a time span as faulty: it is never learned from.

        If the version in force was learned from it, the newest version of the same fans that was not replaces it:
        neither one from before a change of the fans that operators accepted, nor one that is only offered.

        Returns:
            the version that was in force and the one that is now; both empty where the one in force was not
            learned from the span, the second empty where there is no other version.

        Raises:
            UserError: as `add`.
        """
        with self._changing() as listed:
            now_in_force, was, now = listed.current, "", ""
            if now_in_force and overlap(now_in_force.learned_spans, [span]):
                same_fans = [v for v in listed.versions if v.since_t_ns == now_in_force.since_t_ns]
                faulty = (*listed.faulty, span)
                clean = [v.name for v in same_fans if v != listed.waiting and not overlap(v.learned_spans, faulty)]
                was, now = now_in_force.name, clean[-1] if clean else ""
            update = {"faulty": (*listed.faulty, span), "in_force": now or listed.in_force}
            update["is_chosen"] = bool(now) or listed.is_chosen
            self._write(listed.model_copy(update=update))
        return was, now

    @contextmanager
    def _changing(self) -> Iterator[VersionList]:
        """The list, while no other process changes it."""
        with self._lock_file(f"{LIST_NAME}.lock") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            yield self.read()

    def _lock_file(self, name: str) -> IO[bytes]:
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            return (self.folder / name).open("ab")
        except OSError as error:
            raise self._cannot_write(error) from error

    def _write(self, listed: VersionList) -> None:
        try:
            replace_file(self._path, listed.model_dump_json(indent=1).encode())
        except OSError as error:
            raise self._cannot_write(error) from error

    def _cannot_write(self, error: OSError) -> UserError:
        return UserError(f"{self._path}: cannot write the versions of the twin: {error.strerror}")


def learning_folder(run_folder: Path, tray: str) -> Path:
    """Where the healthy history of a tray is kept, and the versions of its twin."""
    return run_folder / "learned" / tray


def overlap(spans: Sequence[TimeSpan], others: Sequence[TimeSpan]) -> bool:
    """Whether any of the spans has a moment in common with any of the others."""
    return any(first <= until and since <= last for first, last in spans for since, until in others)
