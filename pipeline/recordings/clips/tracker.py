"""Which alarm clips are due, kept and may be deleted: a pure core that follows the messages on alarms.

Alarms of one tray that are raised while a clip of that tray is still running share the clip, which is then longer: the
recording of a tray is not kept once for each of its fans. All times are times of receipt on the host's clock.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from fantwin.pipeline.recordings.clips.clip import Clip, ClipAlarm, clip_name
from fantwin.schemas.enums import Transition
from fantwin.schemas.messages import Alarm
from fantwin.schemas.units import NS_PER_S
from fantwin.scoring.alarms.alarm_state import is_silenced

BEFORE_S, AFTER_S = 60.0, 60.0
"""a clip begins so long before its alarm, and ends so long after"""
SETTLED_S = 2.0
"""time after the end of a clip for what comes late; it then waits until all of that is on the disk"""
LONGEST_NS = 600 * NS_PER_S
"""of a clip that more and more alarms extend; the next alarm then begins another one"""
LONGEST_DELAY_NS = 300 * NS_PER_S
"""of an alarm after its onset, that a clip goes back further"""
JUDGED_NS = 100 * NS_PER_S
"""time of judged samples before the onset of an alarm: what is expected of the fan is known by then"""
RETRY_NS = 10 * NS_PER_S
"""after a clip could not be cut"""
SET_BACK_NS = NS_PER_S
"""by which the host's clock goes back without being noticed"""


@dataclass(frozen=True)
class CutResult:
    """What came of cutting a clip."""

    name: str
    size_bytes: int = 0
    """0: it could not be cut"""
    problem: str = ""
    """why not, or what it lacks"""
    may_pass: bool = False
    """it can be cut later: the disk is full, say"""


class ClipTracker:
    """The clips of one recorder."""

    def __init__(
        self,
        clips: Iterable[Clip],
        most_bytes: int,
        *,
        before_s: float = BEFORE_S,
        after_s: float = AFTER_S,
        settled_s: float = SETTLED_S,
    ) -> None:
        """clips: those known from before a restart. most_bytes: of all clips together; 0: no limit."""
        self._clips = {clip.name: clip for clip in clips}
        self._before_ns, self._after_ns = round(before_s * NS_PER_S), round(after_s * NS_PER_S)
        self._settled_ns = round(settled_s * NS_PER_S)
        self._most_bytes = most_bytes
        self._being_cut: set[str] = set()
        self._ended: set[str] = set()
        """clips that ended when the host's clock was set back"""
        self._retry_ns = self._now_ns = 0
        self._failed = ""
        """why a clip could not be cut; until one is"""
        self._not_kept = ""
        """the last clip for which there was no room"""
        self.counts: Counter[str] = Counter()
        self.version = 0
        """higher after each change of `clips`"""

    @property
    def clips(self) -> list[Clip]:
        """All clips, due ones too, in the order of their alarms."""
        return list(self._clips.values())

    @property
    def needed_since_ns(self) -> int | None:
        """What was received from here on is needed by clips that are still to be cut; None: nothing is."""
        return min((clip.judged_since_ns for clip in self._clips.values() if clip.is_due), default=None)

    @property
    def oldest_acknowledged(self) -> Clip | None:
        """The first clip that may be deleted."""
        may_go = (clip for clip in self._clips.values() if clip.is_acknowledged and not clip.is_due)
        return min(may_go, key=lambda clip: clip.until_ns, default=None)

    def add(self, alarm: Alarm, received_t_ns: int) -> None:
        """Follow the next message about an alarm."""
        of_tray = [clip for clip in self._clips.values() if clip.tray == alarm.header.tray]
        if alarm.acknowledged:
            for clip in of_tray:
                self._put(clip.with_acknowledged(alarm))
        elif alarm.transition == Transition.RAISED and not is_silenced(alarm):
            self._raise(alarm, received_t_ns, of_tray)

    def follow(self, now_ns: int) -> None:
        """Follow the host's clock."""
        if now_ns < self._now_ns - SET_BACK_NS:
            self._end_running(now_ns)
        self._now_ns = now_ns

    def due(self, now_ns: int, unsaved_since_ns: int | None = None) -> list[Clip]:
        """The clips to be cut now, which count as being cut until `cut` says what came of it. What a clip over the
        limit of bytes needs is never due: it is not kept. unsaved_since_ns: what was received from then on is not on
        the disk yet; None: all is."""
        self.follow(now_ns)
        found = [
            clip
            for clip in self._clips.values()
            if clip.is_due
            and clip.name not in self._being_cut
            and (clip.name in self._ended or self._is_settled(clip, unsaved_since_ns))
        ]
        if now_ns < self._retry_ns or not found:
            return []
        if self._is_full():
            for clip in found:
                self._drop(clip)
            self._not_kept, self._failed = found[-1].name, ""
            return []
        self._being_cut |= {clip.name for clip in found}
        return found

    def unfinished(self) -> list[Clip]:
        """The clips that are still running, to be cut as far as they go because the recorder stops."""
        running = (clip for clip in self._clips.values() if clip.is_due and clip.name not in self._being_cut)
        return [] if self._is_full() else list(running)

    def cut(self, result: CutResult) -> None:
        """What came of cutting a clip. One that was still running stays due: it goes on after a restart."""
        clip = self._clips.get(result.name)
        is_over = result.name in self._being_cut
        self._being_cut.discard(result.name)
        if clip is None:
            return
        if result.size_bytes:
            self._put(replace(clip, is_due=not is_over, size_bytes=result.size_bytes, problem=_joined(clip, result)))
            self.counts["clips"] += int(is_over)
            self._failed = ""
        elif result.may_pass:
            self._retry_ns = self._now_ns + RETRY_NS
            self._failed = f"clip {result.name} cannot be cut yet: {result.problem}"
        elif is_over:
            self._drop(clip)
            self._failed = f"clip {clip.name} is not kept: {result.problem}"

    def to_delete(self) -> Clip | None:
        """The oldest acknowledged clip, if clips exceed the limit of bytes."""
        return self.oldest_acknowledged if self._is_full() else None

    def deleted(self, clip: Clip) -> None:
        """A clip was deleted to make room: it is no longer known."""
        self._remove(clip)
        self.counts["clips_deleted"] += 1

    def part_deleted(self) -> None:
        """A part that due clips may need was deleted, because the disk was full."""
        for clip in [clip for clip in self._clips.values() if clip.is_due]:
            self._put(replace(clip, problem="a part that it needs was deleted to make room"))

    def problem(self) -> str:
        """Why clips cannot be cut or kept; empty if all is well."""
        if self._not_kept and self._is_full():
            return (
                f"the clip of {self._not_kept} is not kept: clips with unacknowledged alarms fill half of "
                "recorder.keep_share_of_disk: acknowledge alarms, or raise this limit"
            )
        return self._failed

    def _raise(self, alarm: Alarm, received_t_ns: int, of_tray: Sequence[Clip]) -> None:
        if any(
            (each.fan, each.onset_t_ns) == (alarm.fan, alarm.onset_t_ns) for clip in of_tray for each in clip.alarms
        ):
            return
        new = ClipAlarm(alarm.fan, alarm.onset_t_ns, alarm.t_ns)
        delay_ns = min(max(0, alarm.t_ns - alarm.onset_t_ns), LONGEST_DELAY_NS)
        onset_ns, until_ns = received_t_ns - delay_ns, received_t_ns + self._after_ns
        since_ns, judged_since_ns = onset_ns - self._before_ns, onset_ns - max(self._before_ns, JUDGED_NS)
        clip = next((clip for clip in of_tray if self._is_joined(clip, received_t_ns, until_ns)), None)
        if clip is None:
            name = clip_name(alarm, self._clips)
            clip = Clip(name, alarm.header.tray, since_ns, until_ns, judged_since_ns, ())
        self._put(
            replace(
                clip,
                alarms=(*clip.alarms, new),
                since_ns=min(clip.since_ns, since_ns),
                until_ns=max(clip.until_ns, until_ns),
                judged_since_ns=min(clip.judged_since_ns, judged_since_ns),
            )
        )

    def _is_joined(self, clip: Clip, received_t_ns: int, until_ns: int) -> bool:
        """Whether an alarm that is received now belongs to a clip, which then goes on until `until_ns`."""
        is_running = clip.is_due and clip.name not in self._being_cut | self._ended
        is_short = until_ns - clip.since_ns <= LONGEST_NS + self._before_ns + self._after_ns
        return is_running and is_short and clip.since_ns <= received_t_ns <= clip.until_ns

    def _is_settled(self, clip: Clip, unsaved_since_ns: int | None) -> bool:
        """Whether all of a clip has come and is on the disk."""
        is_saved = unsaved_since_ns is None or clip.until_ns < unsaved_since_ns
        return is_saved and clip.until_ns + self._settled_ns <= self._now_ns

    def _end_running(self, now_ns: int) -> None:
        """The host's clock was set back: what is running ends there, and does not wait for that time again."""
        for clip in [clip for clip in self._clips.values() if clip.is_due and clip.until_ns > now_ns]:
            self._put(replace(clip, until_ns=max(clip.since_ns, min(clip.until_ns, self._now_ns))))
            self._ended.add(clip.name)
        self._retry_ns = min(self._retry_ns, now_ns)

    def _is_full(self) -> bool:
        return 0 < self._most_bytes <= sum(clip.size_bytes for clip in self._clips.values())

    def _drop(self, clip: Clip) -> None:
        self.counts["clips_not_kept"] += 1
        if clip.size_bytes:
            self._put(replace(clip, is_due=False))
        else:
            self._remove(clip)

    def _remove(self, clip: Clip) -> None:
        del self._clips[clip.name]
        self.version += 1

    def _put(self, clip: Clip) -> None:
        if self._clips.get(clip.name) != clip:
            self._clips[clip.name] = clip
            self.version += 1


def _joined(clip: Clip, result: CutResult) -> str:
    return "; ".join(dict.fromkeys(filter(None, (clip.problem, result.problem))))
