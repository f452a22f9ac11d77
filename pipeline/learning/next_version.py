"""The next version of a learned twin, from the healthy history of its tray.

First the speeds of the fans over the newest healthy hours are checked against the reference. Where they changed more
than those of healthy fans do, the new version is trained on what came after, and is offered to the operator. Whether
most fans have changed alike is checked near alarms as well: it is no fault of a fan, and may raise one alarm after the
other. Otherwise a new twin is compared with the one in force on what neither has seen. Unless it is clearly better, the
new version is the twin in force with a new calibration.
"""

from __future__ import annotations

import hashlib
import shutil
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from threadpoolctl import threadpool_limits

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.files import write_whole
from fantwin.pipeline.learning.drops_found import drops_found
from fantwin.pipeline.learning.fan_changes import (
    changed_fans,
    changes_from_list,
    changes_to_list,
    have_most_changed_alike,
    mean_changes,
    residual_of,
)
from fantwin.pipeline.learning.fitting import calibrated_on, fit_twin, with_calibration
from fantwin.pipeline.learning.healthy_history import healthy_recordings, recordings_near_alarms
from fantwin.pipeline.learning.history_recordings import HistoryRecording
from fantwin.pipeline.learning.training_data import TrainingData, twin_errors
from fantwin.pipeline.learning.version_data import (
    Split,
    newest_long,
    newest_recordings,
    read_excerpts,
    split,
    spread_parts,
)
from fantwin.pipeline.learning.versions import Check, Drop, Outcome, TwinVersions, Version, VersionList, overlap
from fantwin.pipeline.recordings.excerpts import ExcerptReader
from fantwin.pipeline.replay.offline.healthy_runs import HealthyPart, in_this_process
from fantwin.pipeline.sources.tacho_evidence import tacho_hints
from fantwin.schemas.fan_names import NO_NAMES, FanNames
from fantwin.scoring.calibration.calibration import Calibration, needed_fan_hours

if TYPE_CHECKING:
    from fantwin.schemas.messages import Array

WANTED_S, MOST_S = 12 * 3600.0, 48 * 3600.0
"""of healthy running that a version is calibrated on, and that is used if the declared rate needs more; an hour takes
about 40 seconds"""
MARGIN = 1.3
"""times the healthy running that the rate needs, because not all of it can be scored"""
BETTER = 0.98
"""times the error of the twin in force: a new one must be below it"""
CHECKED_S = 4 * 3600.0
"""of healthy running over which the speeds of the fans are compared with the reference, the newest: longer than the
air of a room varies, and not so long that a change is diluted by the time before it"""
LEAST_CHECKED_S = 3600.0
"""of healthy running since a version was offered: with less nothing is known about how the fans are since then"""
WORK_PREFIX = "learning-"
NO_CHECK = Check(t_ns=0, reference="", change=(), found="", spans=())


def make_next_version(
    folder: Path,
    tray: str,
    per_day: float,
    say: Callable[[str], None],
    names: FanNames = NO_NAMES,
    *,
    only_if_changed: bool = False,
) -> Version | None:
    """Make the next version and add it to the list; it is in force if it was taken.

    per_day: false alarms of a fan to declare. say: called with a progress line for each step. only_if_changed: check
    the fans against the reference, and make a version only if they have changed, and not as for a version that is
    offered already; returns None if they have not.

    Raises:
        UserError: there is nothing to learn from, or too little; a file cannot be read or written.
    """
    versions = TwinVersions(folder, tray)
    with versions.learning():
        return _next_version(versions, per_day, say, names, only_if_changed=only_if_changed)


def _next_version(
    versions: TwinVersions, per_day: float, say: Callable[[str], None], names: FanNames, *, only_if_changed: bool
) -> Version | None:
    folder, listed, name = versions.folder, versions.read(), versions.next_name()
    healthy = healthy_recordings(folder, listed.excluded_spans)
    near_alarms = recordings_near_alarms(folder, listed.excluded_spans)
    if not healthy and not (only_if_changed and near_alarms):
        raise UserError(f"{folder}: no healthy history to learn from yet")
    for left in folder.glob(f"{WORK_PREFIX}*"):  # of a process that was killed
        shutil.rmtree(left, ignore_errors=True)
    with tempfile.TemporaryDirectory(prefix=WORK_PREFIX, dir=folder) as place:
        parts = Path(place), name, versions.file, listed
        work = _Work(*parts, healthy, near_alarms, per_day, say, names) if near_alarms else None
        check = work.checked_alike() if work else None
        if work is None or check is None:
            looked_t_ns = near_alarms[-1].span[1] if near_alarms else 0
            if only_if_changed and near_alarms and _is_too_little_new(healthy, listed):
                versions.add_check((listed.check or NO_CHECK).model_copy(update={"near_t_ns": looked_t_ns}))
                return None
            work = _Work(*parts, healthy, [], per_day, say, names)
            check = work.checked().model_copy(update={"near_t_ns": looked_t_ns})
        is_needed = work.needs_offer() if check.found else not only_if_changed
        if not is_needed:
            versions.add_check(check)
            return None
        version, content = work.offered(check.found) if check.found else work.taken()
    write_whole(versions.file(name), content, "")  # the list must never name a file that is not there
    try:
        versions.add(version, listed, check)
    except UserError:
        versions.file(name).unlink(missing_ok=True)
        raise
    return version


def _is_too_little_new(healthy: Sequence[HistoryRecording], listed: VersionList) -> bool:
    """Whether the newest hours of healthy running are partly from before the last check or version: a change since then
    would be diluted, and the time since then be taken as unchanged. (What is from before a commissioning is left out.)
    """
    needed_s = LEAST_CHECKED_S if listed.newest_t_ns == listed.commissioned_t_ns else CHECKED_S
    return sum(each.seconds for each in healthy if each.span[0] >= listed.newest_t_ns) < needed_s


class _Work:
    """The work on one version."""

    def __init__(
        self,
        place: Path,
        name: str,
        file_of: Callable[[str], Path],
        listed: VersionList,
        healthy: Sequence[HistoryRecording],
        near_alarms: Sequence[HistoryRecording],
        per_day: float,
        say: Callable[[str], None],
        names: FanNames = NO_NAMES,
    ) -> None:
        """file_of: the file of a version. listed: the versions before this one. healthy, near_alarms: what it is made
        from."""
        self._place, self._name, self._file_of, self._listed = place, name, file_of, listed
        self._before, self._per_day, self._say, self._names = listed.current, per_day, say, names
        self._near_alarms = set(near_alarms)
        self._recordings = recordings = sorted([*healthy, *near_alarms], key=lambda each: each.span)
        self._rate_hz, self._fans = _rate_and_fan_count((healthy or near_alarms)[-1])
        needed_s = MARGIN * 3600.0 * needed_fan_hours(per_day) / self._fans
        self._calibration_recordings = newest_recordings(recordings, min(max(WANTED_S, needed_s), MOST_S))
        since_t_ns = max(listed.commissioned_t_ns, listed.waiting.made_t_ns if listed.waiting else 0)
        self._newest = newest_recordings([each for each in recordings if each.span[0] >= since_t_ns], CHECKED_S)

    def checked_alike(self) -> Check | None:
        """The check, if the newest hours were partly near alarms, and most fans have changed alike; else None, also if
        these hours cannot be read: samples near alarms may be of a line that was not in order."""
        reference = self._reference()
        if reference is None or not self._knows_enough or self._near_alarms.isdisjoint(self._newest):
            return None
        self._say(f"{self._name}: checking near alarms, too, whether most fans have changed since {reference.name}")
        try:
            check = self._check(reference)
        except UserError as error:
            self._say(f"{self._name}: running near alarms cannot be used: {error}")
            return None
        return check.model_copy(update={"near_t_ns": self._recordings[-1].span[1]}) if check.found else None

    def checked(self) -> Check:
        """The speeds of the fans over the newest hours beside the reference. Without a reference nothing has changed.
        What was found stays while too little is known since then.

        Raises:
            UserError: too little is known since fans were commissioned again.
        """
        reference = self._reference()
        if reference is None:
            return NO_CHECK.model_copy(update={"t_ns": self._recordings[-1].span[1]})
        if not self._knows_enough:
            if self._listed.waiting and self._listed.check:
                return self._listed.check
            raise UserError(
                f"there is less than {_hours(LEAST_CHECKED_S)} of healthy running since fans were commissioned again: "
                "too little to compare them with the reference; try again later"
            )
        self._say(f"{self._name}: checking the fans against {reference.name}")
        return self._check(reference)

    def _check(self, reference: Version) -> Check:
        healthy = [each for each in self._recordings if each not in self._near_alarms]
        change = self._change_since(reference)
        found = self._changed(change, reference)
        spans = tuple(each.span for each in healthy if found and each.span[1] > self._unchanged_t_ns())
        t_ns = healthy[-1].span[1] if healthy else 0
        return Check(t_ns=t_ns, reference=reference.name, change=changes_to_list(change), found=found, spans=spans)

    def _changed(self, change: Array, since: Version) -> str:
        """What has changed, in words; near alarms only what most fans have alike."""
        counts = not self._near_alarms or have_most_changed_alike(change)
        return changed_fans(change, since.name, self._names) if counts else ""

    def _unchanged_t_ns(self) -> int:
        """Until then the fans are known to have been as when the reference was made."""
        last, taken = self._listed.check, (v.made_t_ns for v in self._listed.versions if v.outcome == "taken")
        return max(last.t_ns if last and not last.found else 0, *taken, 0)

    def needs_offer(self) -> bool:
        """Whether the fans have changed otherwise than when a version was last offered, or none is."""
        last = self._listed.waiting
        return last is None or (self._knows_enough and bool(self._changed(self._change_since(last), last)))

    @property
    def _knows_enough(self) -> bool:
        """Whether there is enough since fans were commissioned again or a version was offered."""
        return self._newest == self._recordings or sum(each.seconds for each in self._newest) >= LEAST_CHECKED_S

    def _change_since(self, version: Version, over: Sequence[HistoryRecording] = ()) -> Array:
        """(fans,) by which share the mean speeds have changed since a version was made: over these recordings, or over
        the newest hours."""
        parts = spread_parts(over) if over else spread_parts(self._newest, CHECKED_S)
        return mean_changes(self._file_of(version.name), parts) - changes_from_list(version.change)

    def offered(self, changed: str) -> tuple[Version, bytes]:
        """A version of the fans after their change. changed: it, in words."""
        after = self._recordings[self._recordings.index(self._first_after_change()) :]
        self._calibration_recordings = self._newest = list(after)
        parts = split(after, self._rate_hz, self._fans)
        return self._made(
            self._trained(parts),
            "trained",
            read_excerpts(parts.comparison),
            "offered",
            f"{changed}; it was learned from running near alarms too" if self._near_alarms else changed,
            learned=after,
            since_t_ns=after[0].span[0],
        )

    def _first_after_change(self) -> HistoryRecording:
        """From this recording on, the fans are surely as they are now. Near alarms recordings are short: those before
        it belong to it as long as the fans had changed in each of them, too."""
        reference, first = self._reference(), self._newest.index(newest_long(self._newest))
        while self._near_alarms and reference and first:
            if not have_most_changed_alike(self._change_since(reference, self._newest[first - 1 : first])):
                break
            first -= 1
        return self._newest[first]

    def taken(self) -> tuple[Version, bytes]:
        """A version that takes over: a newly trained twin if it is better than the one in force, or that one."""
        parts, before = split(self._recordings, self._rate_hz, self._fans), self._before
        trained, test = self._trained(parts), read_excerpts(parts.comparison)
        if before is None:
            return self._made(trained, "trained", test, "taken", "the first one")
        in_force, reference = self._file_of(before.name), self._reference()
        error, error_before = _error(trained, test), _error(in_force, test)
        compared = f"error {error:.3g} {test.speed_unit}, that of {before.name} {error_before:.3g}"
        if self._listed.is_tainted:
            compared = f"{before.name} was learned from a time that is marked as faulty; {compared}"
        if error < BETTER * error_before or self._listed.is_tainted:
            return self._made(trained, "trained", test, "taken", compared, reference)
        why = f"a newly trained twin is less than 2 % better: {compared}"
        return self._made(in_force, "new limits", test, "taken", why, reference)

    def _reference(self) -> Version | None:
        """The version that changes of the fans are measured against, if there is one."""
        return self._listed.reference_of(self._before) if self._before else None

    def _made(
        self,
        twin: Path,
        how: Literal["trained", "new limits"],
        test: TrainingData,
        outcome: Outcome,
        why: str,
        reference: Version | None = None,
        *,
        learned: Sequence[HistoryRecording] | None = None,
        since_t_ns: int | None = None,
    ) -> tuple[Version, bytes]:
        """The version of a twin, calibrated. reference: None: itself. learned, since_t_ns: None: all recordings, and
        as the version in force."""
        before = self._before
        spans = {each.span for each in learned or self._recordings}
        if before and how == "new limits":
            spans |= set(before.learned_spans)  # of its weights
        newest_parts = spread_parts(self._newest or self._recordings[-1:], CHECKED_S)
        calibrated = self._calibrated(twin, test)
        of_reference = self._file_of(reference.name) if reference else twin
        return Version(
            name=self._name,
            how=how,
            made_t_ns=self._recordings[-1].span[1],
            hours=sum(each.seconds for each in self._calibration_recordings) / 3600.0,
            learned_spans=tuple(sorted(spans)),
            since_t_ns=since_t_ns if since_t_ns is not None else before.since_t_ns if before else 0,
            speed_unit=test.speed_unit,
            error=_error(twin, test),
            error_before=_error(self._file_of(before.name), test) if before else None,
            change=changes_to_list(mean_changes(of_reference, newest_parts)),
            reference=reference.name if reference else self._name,
            drops=calibrated.drops,
            declared_per_day=self._per_day,
            is_target=calibrated.calibration.is_target,
            outcome=outcome,
            why=why,
            sha256=hashlib.sha256(calibrated.file).hexdigest(),
        ), calibrated.file

    def _alarms_since(self, t_ns: int) -> int:
        """Alarms that began since then outside of what is marked as faulty, if the time around them is left out: they
        may have been false."""
        if self._near_alarms:
            return 0
        began = (each for each in self._listed.alarms_t_ns if each >= t_ns)
        return sum(not overlap([(each, each)], self._listed.faulty) for each in began)

    def _trained(self, parts: Split) -> Path:
        """A newly trained twin, not calibrated."""
        twin = self._place / f"{self._name}.onnx"
        self._say(f"{self._name}: training")
        training, validation = read_excerpts(parts.training), read_excerpts(parts.validation)
        longest = max(training.runs, key=lambda run: len(run.t_s))
        hints = tacho_hints(longest.t_s, longest.speed_rad_s, longest.tacho, training.fans, training.names)
        if self._before is None and hints:
            place = self._recordings[0].path.parent
            raise UserError(
                f"{hints[0]}: declare the tacho that was found, delete {place}, whose recordings say otherwise, and "
                "start the site again"
            )
        with twin_errors():
            trained = fit_twin(training, validation, self._name)
        write_whole(twin, trained.onnx(), "")
        return twin

    def _calibrated(self, twin: Path, test: TrainingData) -> _CalibratedFile:
        of = self._calibration_recordings
        named, done = self._place / "named.onnx", self._place / "calibrated.onnx"
        with twin_errors():
            # The command line loads twin only when it is needed.
            from fantwin.twin.export.onnx_export import with_card_entries  # noqa: PLC0415

            content = with_card_entries(twin.read_bytes(), {"name": self._name})
        write_whole(named, content, "")
        self._say(f"{self._name}: calibrating on {_hours(sum(each.seconds for each in of))} of healthy running")
        left_out = self._alarms_since(of[0].span[0])
        paths, part = [each.path for each in of], HealthyPart(named)
        with threadpool_limits(1):  # with more threads linear algebra rounds in another order
            found = calibrated_on(
                paths, part, self._per_day, in_this_process, extrapolate=True, alarms_left_out=left_out
            )
        write_whole(done, with_calibration(named, found.calibration), "")
        drops = tuple(drops_found(done, test.rad_s_per_unit))
        return _CalibratedFile(done.read_bytes(), found.calibration, drops)


@dataclass(frozen=True)
class _CalibratedFile:
    file: bytes
    calibration: Calibration
    drops: tuple[Drop, ...]


def _rate_and_fan_count(recording: HistoryRecording) -> tuple[float, int]:
    """Samples a second of a tray, from the first minute, and its number of fans."""
    runs = ExcerptReader(recording.path).read(0.0, 60.0).runs
    seconds = sum(float(run.t_s[-1] - run.t_s[0]) for run in runs)
    return sum(len(run.t_s) for run in runs) / max(seconds, 1e-9), runs[0].command.shape[1]


def _error(twin: Path, data: TrainingData) -> float:
    """Root mean square of the free-run residual over all fans, in the unit of the recordings."""
    residual, _ = residual_of(twin, data)
    squares: Array = np.square(residual)
    return float(np.sqrt(np.nanmean(squares))) / data.rad_s_per_unit


def _hours(seconds: float) -> str:
    return f"{seconds / 60.0:.3g} min" if seconds < 2 * 3600.0 else f"{seconds / 3600.0:.3g} h"
