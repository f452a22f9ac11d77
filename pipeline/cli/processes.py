"""Worker processes of this host that apply one function to many items, several at a time. Results come in the order of
the items.

joblib keeps its processes until they are ended, so that one command can use them several times.
"""

from __future__ import annotations

import signal
import warnings
from collections.abc import Callable, Generator, Sequence
from typing import Any, TypeVar

from joblib import Parallel, delayed, parallel_config
from joblib.externals.loky import BrokenProcessPool, get_reusable_executor

from fantwin.pipeline.errors import UserError

ENDED_FROM_OUTSIDE = "a process that worked on {what} was ended from outside, as the system does if memory is short"

Item = TypeVar("Item")
Result = TypeVar("Result")


def in_processes(work: Callable[[Item], Result], items: Sequence[Item], jobs: int, what: str) -> Generator[Result]:
    """What `work` returns for each item, as results come. When it is closed early, no further item is begun.

    what: the items are, for people.

    Raises:
        UserError: a process was ended from outside.
    """
    with parallel_config("loky", initializer=_leave_ctrl_c_to_the_command):
        options: Any = {"batch_size": 1, "return_as": "generator"}
        parallel: Any = Parallel(jobs, **options)
    try:
        outcomes = parallel(delayed(work)(item) for item in items)
        try:
            for outcome in outcomes:  # noqa: UP028  the end below must come before they are closed
                yield outcome
        finally:
            with warnings.catch_warnings():  # of tasks that are cancelled, as is wanted
                warnings.simplefilter("ignore")
                outcomes.close()
    except BrokenProcessPool as error:
        raise UserError(f"{ENDED_FROM_OUTSIDE.format(what=what)}: fewer --jobs than {jobs} need less") from error


def end_processes() -> None:
    """End those of in_processes, busy or not."""
    running: Any = {"reuse": True}
    get_reusable_executor(**running).shutdown(kill_workers=True)


def _leave_ctrl_c_to_the_command() -> None:
    """A terminal sends it to all processes; the command ends its workers itself."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
