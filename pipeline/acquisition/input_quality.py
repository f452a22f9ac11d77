"""Quality of a source's input: whether it can be used, and what to look at if it cannot."""

from __future__ import annotations

from collections import Counter, deque

from fantwin.pipeline.sources.source import Rejected
from fantwin.schemas.units import NS_PER_S

WINDOW = 100
"""newest inputs from which the quality is computed"""
SILENCE_S = 2.0
"""a source without a valid sample for longer is a problem; twice the pause of the slowest line that can be judged"""
JUDGED_FROM = WINDOW // 5
"""inputs needed for a judgement"""
GOOD_AGAIN = 0.25
"""a source whose input was mostly faulty is in order again below this share: a share near the limit is one problem"""


class InputQuality:
    """The quality of one source's input. Times: host time, ns since the epoch."""

    def __init__(self, started_t_ns: int) -> None:
        self._input_t_ns = self._valid_t_ns = started_t_ns
        self._recent: deque[str] = deque()
        """kind of fault of each of the newest WINDOW inputs; empty: a valid sample"""
        self._faulty = 0
        """number of faulty inputs in `_recent`"""
        self._examples: dict[str, Rejected] = {}
        """first rejected input of each kind since the source was last in order, so that a problem keeps one wording"""
        self._mostly_faulty = False

    def connection_changed(self) -> None:
        """The source was connected or disconnected: what came before says nothing about what follows."""
        self._recent.clear()
        self._faulty = 0
        self._examples.clear()
        self._mostly_faulty = False

    def start_waiting(self, t_ns: int) -> None:
        """Silence counts from this time on."""
        self._input_t_ns = self._valid_t_ns = t_ns

    def wait_no_longer_than_since(self, t_ns: int) -> None:
        """Silence before this time does not count: the clock was set."""
        self._input_t_ns, self._valid_t_ns = max(self._input_t_ns, t_ns), max(self._valid_t_ns, t_ns)

    def add_input(self, t_ns: int) -> None:
        """Note that input has arrived."""
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
        if now_ns - self._input_t_ns > SILENCE_S * NS_PER_S:
            return f"nothing received for {SILENCE_S:g} s; is the source running, connected and sending?"
        has_valid = now_ns - self._valid_t_ns <= SILENCE_S * NS_PER_S
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
