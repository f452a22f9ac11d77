"""What stages have refused, over all their sessions: messages of others, and input of devices that is no usable sample.
Also what devices themselves have refused or lost, if they send their counters.

Refused input is shown apart from losses. A stage that has refused all that its device sent has failed.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Mapping

from fantwin.pipeline.site.loss_accounting import Launched, label
from fantwin.schemas.health import Health

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
