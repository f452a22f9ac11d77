"""The end of a stage: every step runs, whatever an earlier one did, and each has a time limit."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from fantwin.pipeline.errors import UserError

_LEAST_S = 0.05  # a step is given this long even when those before it have used up its time


class Step:
    """An action in a thread of its own, so that waiting for it can be given up."""

    def __init__(self, action: Callable[[], object]) -> None:
        """Begin `action`."""
        self.error: BaseException | None = None
        self._action = action
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def wait(self, timeout_s: float) -> bool:
        """Whether the action has ended; waits for it."""
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        try:
            self._action()
        except BaseException as error:  # noqa: BLE001  reported by the thread that waits for it
            self.error = error


class Ending:
    """The steps that end a stage, and the first error among them.

    The whole end of the stage has one time limit. Each step must be over when a given share of that time has passed. A
    step that is not is left behind in its thread.
    """

    def __init__(self, stage: str, limit_s: float) -> None:
        self._stage = stage
        self._limit_s = limit_s
        self._began_s: float | None = None
        self.error: BaseException | None = None
        self.problem = ""
        """the first error in one line, for health"""
        self.is_hung = False
        """a step was left behind: the process cannot end in order"""

    def begin(self) -> None:
        """The time to end has begun; further calls change nothing."""
        self._began_s = self._began_s or time.monotonic()

    def left_s(self, share: float) -> float:
        """The time until `share` of the whole has passed; before the beginning, all of that."""
        began_s = self._began_s or time.monotonic()
        return began_s + share * self._limit_s - time.monotonic()

    def run(self, what: str, action: Callable[[], object], share: float) -> None:
        """Run a step, which must have ended when `share` of the time has passed; `what` names it for people."""
        self.begin()
        self.finish(what, Step(action), share)

    def finish(self, what: str, step: Step, share: float) -> None:
        """Wait for a step that has begun before."""
        if not step.wait(max(_LEAST_S, self.left_s(share))):
            self.is_hung = True
            self.fail(UserError(f"{self._stage}: {what} did not end in time"), f"{what} did not end in time")
        elif step.error is not None:
            self.fail(step.error, f"{what} failed: {type(step.error).__name__}: {step.error}")

    def fail(self, error: BaseException, problem: str) -> None:
        """Keep the first error."""
        if self.error is None:
            self.error, self.problem = error, problem
