"""A bus without certificates that others can reach: refused unless it is wanted, and then said again and again."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Annotated, TypeAlias

import typer

from fantwin.pipeline.bus.endpoint import is_beyond_loopback
from fantwin.pipeline.config.settings import BusConfig
from fantwin.pipeline.errors import UsageError

AGAIN_S = 60.0
InsecureOption: TypeAlias = Annotated[
    bool,
    typer.Option(
        "--insecure",
        help="Run without certificates on a bus that other hosts reach: whoever reaches it may do everything.",
    ),
]


def is_exposed(bus: BusConfig) -> bool:
    """Whether others may reach this bus, and it has no certificates."""
    return bus.security is None and any(map(is_beyond_loopback, bus.endpoints))


def exposure_problem(bus: BusConfig) -> str:
    """What an exposed bus means, and what to do, in one line."""
    return f"{_what(bus)}: make certificates (`fantwin certs init`), or accept that with --insecure"


def _what(bus: BusConfig) -> str:
    return f"bus.endpoint = {bus.endpoint!r}: whoever reaches it can drive the fans, forge samples and silence alarms"


@contextmanager
def checked_exposure(bus: BusConfig, say: Callable[[str], None], *, insecure: bool) -> Iterator[None]:
    """Refuse, or say each minute while the block runs, that whoever reaches this bus may do everything.

    Raises:
        UsageError: others may reach it, it has no certificates, and it is not to be insecure.
    """
    if not is_exposed(bus):
        yield
        return
    if not insecure:
        raise UsageError(exposure_problem(bus))
    what = _what(bus)
    ended = threading.Event()

    def remind() -> None:
        say(f"insecure: {what}")
        while not ended.wait(AGAIN_S):
            say(f"insecure: {what}")

    thread = threading.Thread(target=remind, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
