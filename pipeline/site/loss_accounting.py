"""What a site has lost and refused, over all sessions of its stages, computed from the last health of each session.

A stage counts what it misses while it runs. The health messages of all sessions together show what it cannot know: what
was published before it first heard a producer, while it was dead, or after it had stopped. There is one rule: of every
stream that a stage reads, each message from the first that is due to it to the last must have reached one of its
sessions.

* First: number 0 where one launcher started both producer and consumer. Otherwise the first that the stage had: what
  came before is history, and so is what was published between two sessions of which the earlier stopped in order.
* Last: once the stage has stopped, the last that is known to be published, if its producer had ended by then: the stage
  has heard the producer's successor, or the launcher stopped the producer first. Otherwise the last that it had.

Where health messages do not say which messages a session lacked, the count is an upper bound: what a killed session
received after its last health, or had not saved by then, counts as lost unless another had it; so does what a session
missed after its first message, up to as many as there are numbers that no earlier one covers. Only what arrived at a
stage that had to end may count too low: it is among what the stage never had, or comes on top, and the larger of the
two counts.

Refused input is shown apart from losses: messages of others, and input of devices that is no usable sample. It includes
what devices themselves have refused or lost, if they send their counters. A stage that has refused all that its device
sent has failed.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

from fantwin.pipeline.config.registry import STAGES
from fantwin.pipeline.runtime.stage import load_stage
from fantwin.schemas.enums import StageStatus
from fantwin.schemas.health import Health
from fantwin.schemas.streams import StreamId, StreamState, input_streams, output_streams
from fantwin.schemas.topics import HEALTH_CHUNK, stage_label

WORDS = {
    "refused_of_replay": "command{s} of a replay",
    "refused_clocks": "clock message{s} from others than the replay",
    "refused_of_other_key": "message{s} of another tray or process than the key names",
    "refused_outputs": "health{s} with outputs that the stage may not write",
    "refused_forged": "message{s} in the name of another session",
    "refused_producers": "message{s} from unknown or too many producers",
    "refused_requests": "request{s} beyond those that may wait",
    "refused_too_large": "message{s} that {are} too large",
    "refused_commands": "command{s} that the tray does not take",
    "refused_other_time": "sample{s} of another time",
    "refused_input": "piece{s} of input that {are} no usable sample",
    "absurd_speed": "speed{s} beyond speed_max",
    "undecodable": "message{s} that cannot be read",
}
"""by counter; see `_counted`"""
ON_THE_DEVICE = {
    "device_bad_length": "frame{s} of a wrong length",
    "device_bad_crc": "frame{s} with a wrong checksum",
    "device_wrong_kind": "frame{s} of another version, type or number of fans",
    "device_bad_value": "command{s} out of range",
    "device_line_errors": "byte{s} with framing errors",
    "device_overruns": "byte{s} that came too fast",
    "device_unsent_samples": "sample{s} for which the line had no room",
    "device_lost_edges": "tacho edge{s} that came too fast",
    "device_host_silences": "silence{s} of the host",
    "device_watchdog_resets": "restart{s} by its watchdog",
}
"""by counter of a device: what it counts; see `_counted`"""
_LINE = "protocol and baud of the [[tray]], and the wiring"
_TIMES = "the times that its client gives"
_SETTINGS = {
    "absurd_age": _TIMES,
    "absurd_command": "command_min and command_max of the [[tray]]",
    "absurd_samples": "speed_max and speed_unit of the [[tray]]",
    "bad_command": "what the device sends as command",
    "bad_number": _LINE,
    "failed_polls": "source of the [[tray]], and the device",
    "garbage": _LINE,
    "malformed": "the form of what is sent (docs/reference/json-samples.md)",
    "oversized": _LINE,
    "skipped_polls": "period_s in source of the [[tray]]",
    "time_order": _TIMES,
    "truncated": _LINE,
    "unknown_command": "where source of the [[tray]] finds the command",
    "wrong_crc": _LINE,
    "wrong_fan_count": "fans of the [[tray]]",
    "wrong_type": "whether the line returns what is sent",
    "wrong_version": "the device's version of the protocol",
}
"""what to look at, by the counter of a fault (docs/reference/wire-protocol.md)"""


def refused(healths: Iterable[Health]) -> dict[str, dict[str, int]]:
    """How much each stage and its device have refused or lost, by the label of the stage and by counter; only counters
    that are not 0. `refused_input` is the sum of the faults of a device's input, whose counters are also included.

    healths: the last of every session.
    """
    known = {*WORDS, *_SETTINGS, *ON_THE_DEVICE}
    found = {name: {c: n for c, n in counts.items() if c in known and n} for name, counts in _sums(healths).items()}
    return {name: counts for name, counts in sorted(found.items()) if counts}


def refused_lines(found: Mapping[str, Mapping[str, int]]) -> list[str]:
    """A line for each stage, and one for its device."""
    lines: list[str] = []
    for name, counts in found.items():
        kinds = ", ".join(
            f"{kind} {count}" for kind, count in counts.items() if kind in _SETTINGS and kind not in WORDS
        )
        words = [_counted(count, WORDS[counter]) for counter, count in counts.items() if counter in WORDS]
        if words:
            lines.append(f"{name}: refused: {', '.join(words)}" + (f" ({kinds})" if kinds else ""))
        there = [
            _counted(count, ON_THE_DEVICE[counter]) for counter, count in counts.items() if counter in ON_THE_DEVICE
        ]
        if there:
            lines.append(f"{name}: counted by the device itself: {', '.join(there)}")
    return lines


def unusable_lines(healths: Iterable[Health], launched: Collection[Launched]) -> list[str]:
    """A line for each device of which no sample could be used: how much was refused, why, and what to look at.

    healths: the last of every session; launched: the sessions that count.
    """
    lines: list[str] = []
    for name, counts in sorted(_sums(each for each in healths if (label(each), each.process_id) in launched).items()):
        pieces = counts["refused_input"] + counts["absurd_samples"]
        kinds = Counter({kind: counts[kind] for kind in _SETTINGS if counts[kind]}).most_common()
        if pieces and counts["samples"] == counts["absurd_samples"]:
            why = ", ".join(f"{kind} {count}" for kind, count in kinds)
            check = f"check {_SETTINGS[kinds[0][0]]}" if kinds else "check source of the [[tray]]"
            were = "was" if pieces == 1 else "were"
            lines.append(
                f"{name}: no sample could be used, {pieces} {were} refused ({why or 'of unknown kind'}): {check}"
            )
    return lines


def _counted(count: int, words: str) -> str:
    """A count with its words, in which {s} ends a plural and {are} is a verb."""
    is_one = count == 1
    return f"{count} {words.format(s='' if is_one else 's', are='is' if is_one else 'are')}"


def _sums(healths: Iterable[Health]) -> dict[str, Counter[str]]:
    """The counters of all sessions of each stage together, by its label."""
    sums: dict[str, Counter[str]] = {}
    for health in healths:
        counts = sums.setdefault(label(health), Counter())
        for each in health.counters:
            counts[each.name] += each.value
    return sums


Launched: TypeAlias = tuple[str, int]
"""label and process id of a session"""
NOT_PROCESSED = "lost_at_stop"
"""the counter of a stage of what had arrived when it had to end; it is not among what its session had"""


def losses(
    healths: Iterable[Health],
    launched: Collection[Launched] | None = None,
    reads: Mapping[str, Collection[str]] | None = None,
) -> dict[str, int]:
    """What each stage has lost, by its label.

    Args:
        healths: the last of every session, in the order in which they were heard.
        launched: the sessions that one launcher has started, and whose losses are wanted. None: those of all sessions,
            of which none is known to have been due a stream from its first message.
        reads: by stage the topics that it reads as configured; None: all of its declaration.
    """
    sessions: dict[str, list[_Session]] = {}
    for health in healths:
        sessions.setdefault(label(health), []).append(_Session(health, input_streams(health)))
    site = _Site(reads or {})
    for own in sessions.values():
        site.add(own, launched or ())
    if launched is not None:
        ours = {name: [each for each in own if each.name in site.launched] for name, own in sessions.items()}
        sessions = {name: own for name, own in ours.items() if own}
    return {name: _lost(own, site) for name, own in sessions.items()}


def label(health: Health) -> str:
    """Name of a process of a stage in messages to people."""
    return stage_label(health.stage, health.instance)


def trays_of(health: Health) -> tuple[str, ...]:
    """The trays of the process of a stage; none: all of the site."""
    return tuple(health.trays.split(",")) if health.trays else ()


@dataclass(frozen=True, slots=True)
class _Session:
    """A session of a stage: its last health, and what that says it received."""

    health: Health
    inputs: dict[StreamId, StreamState]

    @property
    def name(self) -> str:
        """As which it signs its messages."""
        return self.health.header.producer

    @property
    def has_stopped(self) -> bool:
        """Whether it ended in order."""
        return self.health.status == StageStatus.STOPPED

    @property
    def lost_at_stop(self) -> int:
        """What had arrived when it had to end."""
        return sum(counter.value for counter in self.health.counters if counter.name == NOT_PROCESSED)

    @property
    def lost_otherwise(self) -> int:
        """What it lost apart from that and from the missing messages of the streams that it still knows."""
        missing = sum(state.missing for (_, name), state in self.inputs.items() if name)
        return max(0, self.health.lost - missing - self.lost_at_stop)


@dataclass(slots=True)
class _Site:
    """What all sessions say together.

    Attributes:
        published: how many messages of each stream are known to be published.
        followers: by producer, the later sessions of its stage.
        launched: by producer, the stage of those that the launcher has started.
        reads: by stage the topics that it reads, where these are fewer than declared.
    """

    reads: Mapping[str, Collection[str]]
    published: dict[StreamId, int] = field(default_factory=dict)
    followers: dict[str, set[str]] = field(default_factory=dict)
    launched: dict[str, str] = field(default_factory=dict)

    def add(self, own: Sequence[_Session], launched: Collection[Launched]) -> None:
        """Add the sessions of a stage."""
        for number, each in enumerate(own):
            received = {stream: state.next_sequence or 0 for stream, state in each.inputs.items()}
            for stream, count in (*output_streams(each.health).items(), *received.items()):
                if stream[1]:  # without a name: earlier producers, summed up
                    self.published[stream] = max(count, self.published.get(stream, 0))
            self.followers[each.name] = {later.name for later in own[number + 1 :]}
            if (label(each.health), each.health.process_id) in launched:
                self.launched[each.name] = each.health.stage

    def is_due_from_0(self, stream: StreamId, consumer: _Session) -> bool:
        """Whether the launcher started producer and consumer: all that is published is due."""
        key, producer = stream
        both = producer in self.launched and consumer.name in self.launched
        return both and not _is_of_health(key) and self._is_read(consumer.health, key)

    def _is_read(self, health: Health, key: str) -> bool:
        """Whether the stage that reports this is configured to read a key of a tray."""
        stage = health.stage
        if stage not in STAGES:
            return False
        tray, topic = key.split("/")[-2:]
        is_its_tray = tray in (trays_of(health) or (tray,))
        reads = self.reads[stage] if stage in self.reads else load_stage(stage).reads
        return is_its_tray and topic in reads

    def has_ended(self, stream: StreamId, run: Sequence[_Session]) -> bool:
        """Whether the producer of a stream had ended when these sessions of a stage had stopped."""
        key, producer = stream
        if not run[-1].has_stopped:
            return False
        heard = {name for each in run for _, name in each.inputs}
        stage = "" if _is_of_health(key) else self.launched.get(producer, "")
        return not heard.isdisjoint(self.followers.get(producer, ())) or _stops_before(stage, run[-1].health.stage)


def _lost(own: Sequence[_Session], site: _Site) -> int:
    """What one stage has lost, of which these are the sessions."""
    stage = own[-1].health.stage
    if stage in STAGES and STAGES[stage].may_drop:
        return sum(each.health.lost for each in own)
    all_runs = _runs(own)
    within = after = 0
    for stream, published in site.published.items():
        is_due_from_0 = site.is_due_from_0(stream, own[-1])
        runs = [own] if is_due_from_0 else [run for run in all_runs if any(stream in each.inputs for each in run)]
        if not runs or (is_due_from_0 and _is_forgotten(stream, own)):
            continue
        end = 0
        for run in runs:
            states = [each.inputs[stream] for each in run if stream in each.inputs]
            absent, end = _absent(states, is_due_from_0=is_due_from_0)
            within += absent
        if site.has_ended(stream, runs[-1]):
            after += max(0, published - end)
    at_stop = sum(each.lost_at_stop for each in own)
    return sum(each.lost_otherwise for each in own) + within + max(after, at_stop)


def _runs(own: Sequence[_Session]) -> list[list[_Session]]:
    """Sessions that follow one another without a stop in order."""
    runs: list[list[_Session]] = []
    for each in own:
        if not runs or runs[-1][-1].has_stopped:
            runs.append([])
        runs[-1].append(each)
    return runs


def _absent(states: Iterable[StreamState], *, is_due_from_0: bool) -> tuple[int, int]:
    """How many messages of a stream, from the first that is due, none of these sessions of a stage had, and the number
    after the last that one had."""
    had = sorted(states, key=lambda state: state.first_sequence + state.missing_at_start)
    absent, due = 0, 0 if is_due_from_0 else min(state.first_sequence for state in had)
    for state in had:
        begin, end = state.first_sequence + state.missing_at_start, (state.next_sequence or 0) - state.unsaved
        lacking = state.missing - state.missing_at_start
        absent += max(0, begin - due)
        due = max(due, begin)
        absent += min(lacking, max(0, end - due))
        due = max(due, end)
    return absent, due


def _is_forgotten(stream: StreamId, own: Iterable[_Session]) -> bool:
    """Whether it may be among the streams that were forgotten in a flood of names."""
    return any((stream[0], "") in each.inputs for each in own) and not any(stream in each.inputs for each in own)


def _stops_before(producer: str, consumer: str) -> bool:
    """Whether a launcher stops the stage `producer` before `consumer`: in the order of the data flow."""
    order = list(STAGES)
    return producer in STAGES and consumer in STAGES and order.index(producer) < order.index(consumer)


def _is_of_health(key: str) -> bool:
    return key.split("/")[2:3] == [HEALTH_CHUNK]
