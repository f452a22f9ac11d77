"""Work on many recordings or networks, on the cores of this host or of a cluster: the same for each, results in order.

A recording is the unit. What is done with one is a function of it that another process can be given: a function of a
module, or a `partial` of one. Its result is small, or is needed whole; the command joins the results in the order of
its arguments, so it does not matter how many jobs there were.
"""

from __future__ import annotations

import logging
import signal
import warnings
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from functools import partial
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias, TypeVar

import typer
from joblib import Parallel, cpu_count, delayed, parallel_config
from joblib.externals.loky import BrokenProcessPool, get_reusable_executor
from threadpoolctl import threadpool_limits

from fantwin.pipeline.cli.printing import show
from fantwin.pipeline.cli.progress import recordings_progress
from fantwin.pipeline.errors import UsageError, UserError
from fantwin.pipeline.extras import require
from fantwin.pipeline.recordings.remote import local_copies

if TYPE_CHECKING:
    from distributed import Client
    from rich.console import RenderableType

    from fantwin.twin.progress import Progress

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


def _leave_ctrl_c_to_the_command() -> None:
    """A terminal sends it to all processes; the command ends its workers itself."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


JobsOption: TypeAlias = Annotated[
    str | None,
    typer.Option(
        "--jobs",
        "-j",
        metavar="N|tcp://HOST:PORT",
        help="Recordings to work on at a time, default one for each core; or the Dask scheduler of a cluster (extra "
        "`remote`).",
    ),
]
SkipBadOption: TypeAlias = Annotated[
    bool,
    typer.Option("--skip-bad", help="Go on without recordings that cannot be used; exit code 4 if there were any."),
]

EXIT_SKIPPED = 4
CONNECT_S = 10.0
"""for a scheduler to answer, and for its first worker"""
SAME_VERSIONS = ("fantwin", "numpy", "onnxruntime", "scipy")
"""of workers and of the command: results depend on them"""
RECORDINGS = "recordings"

Recording = TypeVar("Recording", Path, tuple[Path, ...])
"""a file, or the parts of one recording"""


class RecordingsInParallel:
    """The processes of one command, and the recordings that it skipped. A context manager: its end is theirs."""

    def __init__(self, jobs: int | str | None = None, skip_bad: bool = False) -> None:
        """jobs: how many, None for one for each core; or the scheduler of a cluster, whose workers take their place.

        Raises:
            UsageError: it is neither.
        """
        self._scheduler = jobs if isinstance(jobs, str) and "://" in jobs else None
        number = str(jobs or cpu_count()) if self._scheduler is None else "1"
        if not number.isdecimal() or number == "0":
            raise UsageError(f"--jobs {jobs}: give a number from 1, or the scheduler of a cluster: tcp://HOST:PORT")
        self.jobs = int(number)
        """at a time on this host"""
        self._skip_bad = skip_bad
        self._resources = ExitStack()
        self._client: Client | None = None
        self._copies: Path | None = None
        self._has_processes = False
        self._bad: dict[Path | tuple[Path, ...], UserError] = {}

    def __enter__(self) -> RecordingsInParallel:
        folder = TemporaryDirectory(prefix="fantwin-copies-", ignore_cleanup_errors=True)
        self._copies = Path(self._resources.enter_context(folder))
        return self

    def __exit__(self, *_error: object) -> None:
        if self._has_processes:
            running: Any = {"reuse": True}
            get_reusable_executor(**running).shutdown(kill_workers=True)  # a fit that follows needs their memory
        self._has_processes, self._client = False, None
        self._resources.close()

    def map(self, work: Callable[[Recording], Result], recordings: Sequence[Recording], doing: str) -> Iterator[Result]:
        """What `work` returns for each recording, in their order, as results come; those skipped before stay left out.

        doing: what is done, for people.

        Raises:
            UserError: of the first recording that `work` raises it for, unless bad ones are skipped or none is left; or
                there is no such scheduler, or no worker.
        """
        if self._scheduler and self._client is None:
            self._client = self._resources.enter_context(_connected(self._scheduler))
        left = [recording for recording in recordings if recording not in self._bad]
        attempt = partial(_attempt, work=work, copies=self._copies)
        begun = self._on_cluster(attempt, left) if self._client else self._here(attempt, left)
        with recordings_progress(doing, len(left)) as advance, closing(begun) as outcomes:
            for recording, outcome in zip(left, outcomes, strict=True):
                if isinstance(outcome, UserError):
                    if not self._skip_bad:
                        raise outcome
                    self._bad[recording] = outcome
                else:
                    yield outcome
                advance()
        if recordings and all(recording in self._bad for recording in recordings):
            raise self._bad[recordings[0]]

    def each_network(
        self, work: Callable[[Item, Progress], Result], items: Sequence[Item], doing: str, progress: Progress
    ) -> list[Result]:
        """A twin.network_training.ForEachNetwork with processes of this host.

        Raises:
            UserError: a process was ended from outside.
        """
        from fantwin.twin.network_training import one_after_another  # noqa: PLC0415  loaded only when it is needed

        jobs = min(self.jobs, len(items))
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

    def _here(self, attempt: Callable[[Recording], Any], recordings: Sequence[Recording]) -> Generator[Any]:
        """The outcomes in the order of the recordings. When it is closed early, the processes are ended."""
        jobs = min(self.jobs, max(len(recordings), 1))
        self._has_processes |= jobs > 1
        return in_processes(attempt, recordings, jobs, RECORDINGS)

    def _on_cluster(self, attempt: Callable[[Recording], Any], recordings: Sequence[Recording]) -> Generator[Any]:
        """The same on the workers of a cluster. When it is closed early, what has not begun is cancelled.

        joblib's Dask backend is not used: with joblib 1.6 it waits for ever for the task of a worker that was killed.
        """
        from distributed import CancelledError, KilledWorker  # noqa: PLC0415  an extra, which is there now
        from distributed.comm.core import CommClosedError  # noqa: PLC0415

        assert self._client
        futures = deque(self._client.map(attempt, recordings, pure=False))
        try:
            while futures:
                yield futures.popleft().result()  # a result that is held nowhere else is forgotten by the cluster
        except KilledWorker as error:
            raise UserError(f"{ENDED_FROM_OUTSIDE.format(what=RECORDINGS)}: see {self._scheduler}") from error
        except (CancelledError, CommClosedError, TimeoutError) as error:
            raise UserError(f"--jobs {self._scheduler}: the connection to it was lost") from error
        finally:
            self._client.cancel(list(futures))

    def as_json(self) -> dict[str, list[dict[str, str]]]:
        """The skipped recordings, for --json; empty where none are to be skipped."""
        skipped = [{"recording": name_of(recording), "reason": str(error)} for recording, error in self._bad.items()]
        return {"skipped": skipped} if self._skip_bad else {}

    def end_with(
        self, found: dict[str, Any], *lines: RenderableType, warnings: Iterable[str], json_output: bool
    ) -> None:
        """Print a result and what was skipped, and end the command. warnings: beside the lines, on stderr.

        Raises as `end`.
        """
        show(found | self.as_json(), *lines, json_output=json_output)
        for warning in () if json_output else warnings:
            typer.echo(warning, err=True)
        self.end()

    def end(self, exit_code: int = 0) -> None:
        """Name the recordings that were skipped, on stderr, and end the command.

        exit_code: another one, which counts more.

        Raises:
            typer.Exit: the code is not 0.
        """
        for error in self._bad.values():
            typer.secho(f"skipped: {error}", fg=typer.colors.YELLOW, err=True)
        if exit_code or self._bad:
            raise typer.Exit(exit_code or EXIT_SKIPPED)


def name_of(recording: Path | tuple[Path, ...]) -> str:
    """The name of a recording for people: of several parts, that of the first."""
    return str(recording[0] if isinstance(recording, tuple) else recording)


def _attempt(recording: Recording, work: Callable[[Recording], Result], copies: Path | None) -> Result | UserError:
    """A result, or in its place an error, which crosses processes as it is. Runs in any process.

    With several threads, linear algebra rounds in another order: there is one everywhere.
    """
    try:
        with local_copies(copies), threadpool_limits(1):
            return work(recording)
    except UsageError:
        raise
    except UserError as error:
        files = recording if isinstance(recording, tuple) else (recording,)
        is_named = any(str(file) in str(error) for file in files)
        return error if is_named else UserError(f"{name_of(recording)}: {error}")


@contextmanager
def _connected(scheduler: str) -> Iterator[Client]:
    """A client of a cluster that has workers, all with the versions of this process.

    Raises:
        UserError: there is none, or the extra is missing.
    """
    require("--jobs on a cluster", "remote", "distributed")
    from distributed import Client  # noqa: PLC0415  an extra

    for name in ("asyncio", "distributed", "distributed.client"):
        logging.getLogger(name).setLevel(logging.CRITICAL)  # what goes wrong is raised as well, and is one line then
    try:
        client = Client(scheduler, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise UserError(f"--jobs {scheduler}: no Dask scheduler answers there") from error
    with client:
        try:
            client.wait_for_workers(1, timeout=CONNECT_S)
        except TimeoutError as error:
            raise UserError(
                f"--jobs {scheduler}: it has no workers; start some: dask worker {scheduler} --nthreads 1"
            ) from error
        own = _versions()
        versions: Any = client.run(_versions, on_error="return")
        for worker, found in versions.items():
            if found != own:
                raise UserError(f"worker {worker} has {found}, this command {own}: install the same everywhere")
        yield client


def _versions() -> str:
    return ", ".join(f"{package} {version(package)}" for package in SAME_VERSIONS)


def _alone(work: Callable[[Item, Progress], Result], item: Item) -> Result:
    """Runs in another process. With several threads linear algebra rounds in another order: there is one everywhere."""
    from fantwin.twin.progress import unreported  # noqa: PLC0415

    with threadpool_limits(1):
        return work(item, unreported)
