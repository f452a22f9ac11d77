"""The sweep of one tray that an operator starts from the page: `fantwin command --sweep` beside the learner."""

from __future__ import annotations

import threading
from collections.abc import Sequence

from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.learning.child_command import ChildCommand
from fantwin.pipeline.learning.sweep_steps import FANS_KEEP, LONGEST_S, SHORTEST_S, duration_s, range_in_words, turning
from fantwin.schemas.enums import Action
from fantwin.schemas.health import Sweep
from fantwin.schemas.messages import Request
from fantwin.schemas.units import NS_PER_S

ROUNDS = 2
LEFT_WITHIN_S = 6.0
"""for the fans to be left at their former commands when the learner ends: acquisition answers within five seconds"""
OLDEST_NS = 30 * NS_PER_S
"""an older request is not what an operator wants now; clocks of hosts may differ by less"""
TURN = threading.Lock()
"""of the children: one tray at a time, as all together would cool less"""


def plan_of(tray: TrayConfig) -> str:
    """What a sweep of a tray does to its fans, for a person who is about to start it."""
    fans = tray.names.labels(range(tray.fans))
    shortest, longest = (duration_s(ROUNDS, each) / 60.0 for each in (SHORTEST_S, LONGEST_S))
    return (
        f"{fans} of {tray.name}: {range_in_words(tray, *turning(tray))}, up and down, in steps as long as the fans "
        f"need: {shortest:.0f} to {longest:.0f} minutes in all. Nothing else may set their commands meanwhile. At the "
        "end, also when it is stopped, each fan gets the command that it had before."
    )


class RequestedSweep:
    """What a learner was asked, and the child that does it."""

    def __init__(self, tray: TrayConfig, tray_words: Sequence[str], child: ChildCommand) -> None:
        """tray_words: the options that name configuration and tray."""
        self._plan = plan_of(tray)
        self._words = ["command", "--sweep", "--rounds", str(ROUNDS), *tray_words]
        self._child = child
        self._ended, self._asked_t_ns, self._asked_by = "", 0, ""

    @property
    def is_running(self) -> bool:
        """Whether it moves the fans."""
        return self._child.seconds is not None

    def take(self, request: Request, now_ns: int, why_not: str) -> None:
        """Begin or stop it. now_ns: the present time. why_not: why none may begin; empty: it may."""
        self._asked_t_ns = request.t_ns
        if request.action == Action.STOP_SWEEP:
            self.ask_to_end()
        elif not self.is_running:
            if abs(now_ns - request.t_ns) > OLDEST_NS:
                why_not = f"the request is {(now_ns - request.t_ns) / NS_PER_S:.0f} s old: set the hosts' clocks"
            elif not self._child.is_free:
                why_not = "another tray is being swept: wait until that has ended"
            why_not = why_not or self._child.begin(self._words)
            self._ended, self._asked_by = (
                f"the sweep was not begun: {why_not}" if why_not else "",
                request.operator_name,
            )

    def tick(self) -> None:
        """See whether it has ended."""
        status = self._child.ended()
        if status is not None and status < 0:
            self._ended = f"the sweep was ended by signal {-status}: {FANS_KEEP}; send others by hand"
        elif status is not None:
            self._ended = self._child.last_line or f"`fantwin command --sweep` ended with status {status}"

    def ask_to_end(self) -> None:
        """The fans get their former commands, and it ends."""
        self._child.ask_to_end()

    def end(self) -> None:
        """The same, and wait for it. One that takes longer ends by itself."""
        self._child.end(LEFT_WITHIN_S)

    def now(self) -> Sweep:
        """What the page shows."""
        running = (self._child.last_line or "it begins") if self.is_running else ""
        return Sweep(plan=self._plan, running=running, ended=self._ended, asked_t_ns=self._asked_t_ns)

    def note(self) -> str:
        """What it does or how it has ended, for people; empty: nothing was asked."""
        if not self.is_running:
            return "" if self.problem() else self._ended
        return f"the fans are moved, as {self._asked_by or 'an operator'} has asked: {self.now().running}"

    def problem(self) -> str:
        """Fans that were not left as they should be."""
        return self._ended if FANS_KEEP in self._ended else ""
