"""Who trains the networks of a twin: one after another, or several at a time. They do not depend on each other."""

from collections.abc import Callable, Sequence
from typing import Protocol, TypeVar

from fantwin.twin.progress import Progress, within

Item = TypeVar("Item")
Result = TypeVar("Result")


class ForEachNetwork(Protocol):
    """Applies a function to each network. Results do not depend on the process that runs it."""

    def __call__(
        self, work: Callable[[Item, Progress], Result], items: Sequence[Item], doing: str, progress: Progress
    ) -> list[Result]:
        """What `work` returns for each item, in their order. `work`, items and results can go to other processes.

        doing: what is done, for people. progress: of all of them together.
        """
        ...


def one_after_another(
    work: Callable[[Item, Progress], Result], items: Sequence[Item], doing: str, progress: Progress
) -> list[Result]:
    """A ForEachNetwork in this process. `work` reports what it does itself."""
    count = len(items)
    return [
        work(item, within(f"network {number} of {count}", progress) if count > 1 else progress)
        for number, item in enumerate(items, start=1)
    ]
