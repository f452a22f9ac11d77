"""Quality of a source's input: which readings are plausible, and what to look at where none can be used."""

from __future__ import annotations

import math
from collections import Counter, deque
from dataclasses import dataclass, field, replace

from fantwin.pipeline.acquisition.sample_blocks import DeviceSequence
from fantwin.pipeline.sources.source import Noted, Reading, ReadingLimits, Rejected
from fantwin.schemas.channels import BY_NAME, Channel
from fantwin.schemas.units import NS_PER_S

LONGEST_DETAIL = 120
"""characters of the fault of a refused input, which may quote it; each health contains it"""


@dataclass
class Plausibility:
    """Checks the readings of one tray, and adds those that are refused to its counts, quality and sequence."""

    limits: ReadingLimits
    speed_unit: str
    counts: Counter[str]
    quality: InputQuality
    sequence: DeviceSequence
    measured: list[Channel] = field(default_factory=list)
    """the channels that the source has given"""
    first_refused: dict[str, str] = field(default_factory=dict)
    """fault of the first refused input, by kind"""
    last_noted: dict[str, str] = field(default_factory=dict)
    """what the source has last noted of its device, by kind"""

    def plausible(self, item: Reading | Rejected | Noted) -> Reading | None:
        """The reading, without implausible speeds; None, and counted, if it cannot be used or is none."""
        if isinstance(item, Noted):
            self.counts[item.kind] += 1
            self.last_noted[item.kind] = _shortened(item.detail)
            return None
        if isinstance(item, Reading) and self._is_ordinary(item):
            self.counts["no_speed"] += 0  # shown from the first reading on
            self.quality.add_valid()
            return item
        rejected = item if isinstance(item, Rejected) else self.limits.why_refused(item)
        if rejected is None:
            assert isinstance(item, Reading)
            return self._with_plausible_speeds(item)
        self.counts[rejected.kind] += 1
        self.sequence.refused += rejected.is_sample
        if not rejected.harmless:
            self.counts["refused_input"] += 1
            rejected = replace(rejected, detail=_shortened(rejected.detail))
            self.quality.add_fault(rejected)
            self.first_refused.setdefault(rejected.kind, rejected.detail)
        return None

    def _is_ordinary(self, reading: Reading) -> bool:
        """Return whether all values are there and plausible, as in nearly all readings; a sum shows any not finite."""
        command, speed, limits = reading.command, reading.speed, self.limits
        return (
            len(command) == len(speed) == limits.fans
            and math.isfinite(sum(command) + sum(speed))
            and limits.command_min <= min(command)
            and max(command) <= limits.command_max
            and -limits.speed_max <= min(speed)
            and max(speed) <= limits.speed_max
        )

    def _with_plausible_speeds(self, reading: Reading) -> Reading:
        speed_max = self.limits.speed_max
        self.counts["no_speed"] += sum(map(math.isnan, reading.speed))
        if not self.limits.has_stand_in and (unknown := sum(map(math.isnan, reading.command))):
            self.counts["fans_without_command"] += unknown
        absurd = [speed for speed in reading.speed if abs(speed) > speed_max]
        if not absurd:
            self.quality.add_valid()
            return reading
        self.counts["absurd_speed"] += len(absurd)
        speeds = tuple(math.nan if abs(v) > speed_max else v for v in reading.speed)
        if all(map(math.isnan, speeds)):
            self.counts["absurd_samples"] += 1
            detail = f"speed {absurd[0]:g} is beyond speed_max = {speed_max:g} {self.speed_unit}"
            self.quality.add_fault(Rejected("absurd_speed", detail, setting="speed_max and speed_unit"))
        else:
            self.quality.add_valid()
        return replace(reading, speed=speeds)

    def count_unknown(self, reading: Reading, stand_in: str) -> None:
        """Count the fans for whose command nothing stands; where that is so of all, health says it."""
        unknown = sum(map(math.isnan, reading.command))
        if unknown < len(reading.command):
            self.counts["fans_without_command"] += unknown
            return
        self.counts["unknown_command"] += 1
        self.last_noted["unknown_command"] = f"{stand_in}: the source gives no such value of any fan; none is judged"

    def with_plausible_columns(self, reading: Reading) -> Reading:
        """The reading with NaN where a value beside command and speed cannot be true, or the source has left it out.

        A source that gives a column in some samples only, such as a temperature once a second, has it in all.
        """
        if not (self.measured or reading.measured):
            return reading
        unknown = (math.nan,) * self.limits.fans
        measured = dict.fromkeys((each.name for each in self.measured), unknown)
        for name, values in reading.measured.items():
            if not values:
                continue
            each = BY_NAME.get(name)
            if each is None:
                self.counts["unknown_channel"] += 1
                continue
            if each not in self.measured:
                self.measured.append(each)
            if len(values) == self.limits.fans:
                measured[name] = tuple(value if each.is_plausible(value) else math.nan for value in values)
                absurd = sum(not (each.is_plausible(value) or math.isnan(value)) for value in values)
            else:
                measured[name], absurd = unknown, len(values)
            if absurd:
                self.counts[f"absurd_{each.key}"] += absurd
        return replace(reading, measured=measured)


def _shortened(detail: str) -> str:
    return detail if len(detail) <= LONGEST_DETAIL else f"{detail[:LONGEST_DETAIL]}..."


WINDOW = 100
"""newest inputs from which the quality is computed"""
SILENCE_S = 2.0
"""silence of a source that is a problem, at least; and SILENT_STEPS steps between its inputs, if that is longer"""
SILENT_STEPS, LONGEST_STEP_NS = 2.5, 60 * NS_PER_S
JUDGED_FROM = WINDOW // 5
"""inputs needed for a judgement"""
GOOD_AGAIN = 0.25
"""a source whose input was mostly faulty is in order again below this share: a share near the limit is one problem"""


class InputQuality:
    """The quality of one source's input. Times: host time, ns since the epoch."""

    def __init__(self, started_t_ns: int, period_s: float = 0.0) -> None:
        """period_s: of a source that is polled."""
        self._input_t_ns = self._valid_t_ns = started_t_ns
        self._recent: deque[str] = deque()
        """kind of fault of each of the newest WINDOW inputs; empty: a valid sample"""
        self._faulty = 0
        """number of faulty inputs in `_recent`"""
        self._examples: dict[str, Rejected] = {}
        """first rejected input of each kind since the source was last in order, so that a problem keeps one wording"""
        self._mostly_faulty = False
        self._steps_ns = deque([round(period_s * NS_PER_S)], maxlen=3)
        """newest steps between inputs"""
        self._has_input = False
        """whether there was one since the source is waited for"""

    def connection_changed(self) -> None:
        """The source was connected or disconnected: what came before says nothing about what follows."""
        self._recent.clear()
        self._faulty = 0
        self._examples.clear()
        self._mostly_faulty = self._has_input = False

    def start_waiting(self, t_ns: int) -> None:
        """Silence counts from this time on."""
        self._has_input = False
        self._input_t_ns = self._valid_t_ns = t_ns

    def wait_no_longer_than_since(self, t_ns: int) -> None:
        """Silence before this time does not count: the clock was set."""
        self._input_t_ns, self._valid_t_ns = max(self._input_t_ns, t_ns), max(self._valid_t_ns, t_ns)

    def add_input(self, t_ns: int) -> None:
        """Note that input has arrived."""
        if self._has_input:
            self._steps_ns.append(min(t_ns - self._input_t_ns, LONGEST_STEP_NS))
        self._has_input = True
        self._input_t_ns = t_ns

    def add_valid(self) -> None:
        """Count a valid sample in the newest input."""
        self._valid_t_ns = self._input_t_ns
        self._add("")

    def add_fault(self, rejected: Rejected) -> None:
        """Count a fault in the newest input."""
        self._examples.setdefault(rejected.kind, rejected)
        self._add(rejected.kind)

    def problem(self, now_ns: int, settings: str) -> str:
        """Problem of the source now, and what to check; empty if there is none.

        settings: of the tray, to be checked where the fault does not say which one it is.
        """
        silence_s = max(SILENCE_S, SILENT_STEPS * sorted(self._steps_ns)[len(self._steps_ns) // 2] / NS_PER_S)
        if now_ns - self._input_t_ns > silence_s * NS_PER_S:
            return f"nothing received for {silence_s:.3g} s; is the source running, connected and sending?"
        has_valid = now_ns - self._valid_t_ns <= silence_s * NS_PER_S
        if has_valid and not self._mostly_faulty:
            return ""
        fault = self._fault()
        of_fault = f" ({fault.kind}: {fault.detail})" if fault else ""
        if fault and fault.setting:
            settings = fault.setting
        if has_valid and "" in self._recent:
            return f"most input is faulty{of_fault}; check the wiring, and {settings} of the [[tray]]"
        return f"no valid sample{of_fault}; check {settings} of the [[tray]]"

    def _add(self, kind: str) -> None:
        self._recent.append(kind)
        self._faulty += bool(kind)
        if len(self._recent) > WINDOW:
            self._faulty -= bool(self._recent.popleft())
        if not self._faulty:
            self._examples.clear()
        limit = GOOD_AGAIN if self._mostly_faulty else 0.5
        self._mostly_faulty = len(self._recent) >= JUDGED_FROM and self._faulty > limit * len(self._recent)

    def _fault(self) -> Rejected | None:
        """An example of the fault that is most frequent."""
        kinds = Counter(filter(None, self._recent)).most_common(1)
        return self._examples[kinds[0][0]] if kinds else None
