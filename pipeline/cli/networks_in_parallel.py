"""The networks of a twin, trained on the cores of this host: the twin is the same, however many at a time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from functools import partial
from typing import TYPE_CHECKING, TypeVar

from joblib import cpu_count
from threadpoolctl import threadpool_limits

from fantwin.pipeline.cli.processes import end_processes, in_processes

if TYPE_CHECKING:
    from fantwin.twin.progress import Progress

Item = TypeVar("Item")
Result = TypeVar("Result")


class NetworksInParallel:
    """A twin.networks.ForEachNetwork with processes. A context manager: its end is theirs."""

    def __init__(self, jobs: int | None = None) -> None:
        """jobs: networks at a time; None: one for each core."""
        self._jobs = jobs or cpu_count()
        self._has_processes = False

    def __enter__(self) -> NetworksInParallel:
        return self

    def __exit__(self, *_error: object) -> None:
        if self._has_processes:
            end_processes()

    def __call__(
        self, work: Callable[[Item, Progress], Result], items: Sequence[Item], doing: str, progress: Progress
    ) -> list[Result]:
        """See twin.networks.ForEachNetwork.

        Raises:
            UserError: a process was ended from outside.
        """
        from fantwin.twin.networks import one_after_another  # noqa: PLC0415  loaded only when it is needed

        jobs = min(self._jobs, len(items))
        if jobs == 1:
            with threadpool_limits(1):
                return one_after_another(work, items, doing, progress)
        self._has_processes = True
        part, results = f"{doing}, {jobs} networks at a time", list[Result]()
        with closing(in_processes(partial(_alone, work), items, jobs, "a network")) as found:
            progress(part, 0, len(items), float("nan"))
            for result in found:
                results.append(result)
                progress(part, len(results), len(items), float("nan"))
        return results


def _alone(work: Callable[[Item, Progress], Result], item: Item) -> Result:
    """Runs in another process. With several threads linear algebra rounds in another order: there is one everywhere."""
    from fantwin.twin.progress import unreported  # noqa: PLC0415

    with threadpool_limits(1):
        return work(item, unreported)
