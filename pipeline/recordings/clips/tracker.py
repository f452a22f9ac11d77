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

BEFORE_NS, AFTER_NS = 60 * NS_PER_S, 60 * NS_PER_S
"""a clip begins so long before its alarm, and ends so long after"""
SETTLED_NS = 2 * NS_PER_S
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

    def __init__(self, clips: Iterable[Clip], most_bytes: int, kept_s: float = 0.0) -> None:
        """clips: those known from before a restart. most_bytes: of all clips together; kept_s: how long acknowledged
        ones are kept; 0: no limit."""
        self._clips = {clip.name: clip for clip in clips}
        self._most_bytes, self._kept_ns = most_bytes, round(kept_s * NS_PER_S)
        self._ended: set[str] = set()
        """clips that ended when the host's clock was set back"""
        self._retry_ns = self._now_ns = 0
        self._failed = ""
        """why a clip could not be cut; until one is"""
        self._being_cut: set[str] = set()
        self._not_kept = ""
        """the last clip for which there was no room"""
        self.counts: Counter[str] = Counter()

    @property
    def clips(self) -> list[Clip]:
        """All clips, due ones too, in the order of their alarms."""
        return list(self._clips.values())

    @property
    def to_delete(self) -> Clip | None:
        """The oldest acknowledged clip, if it is too old or clips exceed the limit of bytes."""
        may_go = (clip for clip in self._clips.values() if clip.is_acknowledged and not clip.is_due)
        oldest = min(may_go, key=lambda clip: clip.until_ns, default=None)
        return oldest if oldest and (self.is_full or self._is_old(oldest)) else None

    @property
    def beyond(self) -> list[Clip]:
        """The clips that are kept longer only until their alarms are acknowledged."""
        return [clip for clip in self._clips.values() if self._is_old(clip) and not clip.is_acknowledged]

    @property
    def is_full(self) -> bool:
        """Whether clips exceed the limit of bytes."""
        return 0 < self._most_bytes <= sum(clip.size_bytes for clip in self._clips.values())

    def add(self, alarm: Alarm, received_t_ns: int) -> None:
        """Follow the next message about an alarm."""
        of_tray = [clip for clip in self._clips.values() if clip.tray == alarm.header.tray]
        if alarm.acknowledged:
            self._clips |= {clip.name: clip.with_acknowledged(alarm) for clip in of_tray}
        elif alarm.transition == Transition.RAISED and not is_silenced(alarm):
            self._raise(alarm, received_t_ns, of_tray)

    def follow(self, now_ns: int) -> None:
        """Follow the host's clock."""
        if now_ns < self._now_ns - SET_BACK_NS:
            self._end_running(now_ns)
        self._now_ns = now_ns

    def due(self, now_ns: int) -> list[Clip]:
        """The clips to be cut now. What a clip over the limit of bytes needs is never due: it is not kept."""
        self.follow(now_ns)
        found = [
            clip
            for clip in self._clips.values()
            if clip.is_due and (clip.name in self._ended or clip.until_ns + SETTLED_NS <= now_ns)
        ]
        self._being_cut = set()
        if now_ns < self._retry_ns or not found:
            return []
        if self.is_full:
            self._drop(*found)
            self._not_kept, self._failed = found[-1].name, ""
            return []
        self._being_cut = {clip.name for clip in found}
        return found

    def cut(self, result: CutResult) -> None:
        """What came of cutting a clip."""
        clip = self._clips[result.name]
        if result.size_bytes:
            size_bytes, problem = result.size_bytes, result.problem
            self._clips[clip.name] = replace(clip, is_due=False, size_bytes=size_bytes, problem=problem)
            self.counts["clips"] += 1
            self._failed = ""
        elif result.may_pass:
            self._retry_ns = self._now_ns + RETRY_NS
            self._failed = f"clip {clip.name} cannot be cut yet: {result.problem}"
        else:
            self._drop(clip)
            self._failed = f"clip {clip.name} is not kept: {result.problem}"

    def deleted(self, clip: Clip) -> None:
        """A clip was deleted to make room: it is no longer known."""
        del self._clips[clip.name]
        self.counts["clips_deleted"] += 1

    def problem(self) -> str:
        """Why clips cannot be cut or kept; empty if all is well."""
        if self._not_kept and self.is_full:
            return (
                f"the clip of {self._not_kept} is not kept: clips with unacknowledged alarms fill half of "
                "recorder.keep_share_of_disk: acknowledge alarms, or raise this limit"
            )
        return self._failed

    def _is_old(self, clip: Clip) -> bool:
        return 0 < self._kept_ns < self._now_ns - clip.until_ns

    def _raise(self, alarm: Alarm, received_t_ns: int, of_tray: Sequence[Clip]) -> None:
        name = alarm.fan, alarm.onset_t_ns
        if any((each.fan, each.onset_t_ns) == name for clip in of_tray for each in clip.alarms):
            return
        delay_ns = min(max(0, alarm.t_ns - alarm.onset_t_ns), LONGEST_DELAY_NS)
        onset_ns, until_ns = received_t_ns - delay_ns, received_t_ns + AFTER_NS
        since_ns, judged_since_ns = onset_ns - BEFORE_NS, onset_ns - max(BEFORE_NS, JUDGED_NS)
        clip = next((clip for clip in of_tray if self._is_joined(clip, received_t_ns, until_ns)), None)
        if clip is None:
            clip = Clip(clip_name(alarm, self._clips), alarm.header.tray, since_ns, until_ns, judged_since_ns, ())
        self._clips[clip.name] = replace(
            clip,
            alarms=(*clip.alarms, ClipAlarm(*name, alarm.t_ns, alarm.fan_name)),
            since_ns=min(clip.since_ns, since_ns),
            until_ns=max(clip.until_ns, until_ns),
            judged_since_ns=min(clip.judged_since_ns, judged_since_ns),
        )

    def _is_joined(self, clip: Clip, received_t_ns: int, until_ns: int) -> bool:
        """Whether an alarm that is received now belongs to a clip, which then goes on until `until_ns`."""
        is_running = clip.is_due and clip.name not in self._ended | self._being_cut
        is_short = until_ns - clip.since_ns <= LONGEST_NS + BEFORE_NS + AFTER_NS
        return is_running and is_short and clip.since_ns <= received_t_ns <= clip.until_ns

    def _end_running(self, now_ns: int) -> None:
        """The host's clock was set back: what is running ends there, and does not wait for that time again."""
        for clip in [clip for clip in self._clips.values() if clip.is_due and clip.until_ns > now_ns]:
            until_ns = max(clip.since_ns, min(clip.until_ns, self._now_ns))
            self._clips[clip.name] = replace(clip, until_ns=until_ns)
            self._ended.add(clip.name)
        self._retry_ns = min(self._retry_ns, now_ns)

    def _drop(self, *clips: Clip) -> None:
        for clip in clips:
            del self._clips[clip.name]
            self.counts["clips_not_kept"] += 1
