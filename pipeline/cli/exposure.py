"""A bus without certificates that others can reach: refused unless it is wanted, and then said again and again."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Annotated, TypeAlias

import typer

from pipeline.bus.endpoint import is_beyond_loopback
from pipeline.config.models import BusConfig
from pipeline.errors import UsageError

AGAIN_S = 60.0
InsecureOption: TypeAlias = Annotated[
    bool,
    typer.Option(
        "--insecure",
        help="Run without certificates on a bus that other hosts reach: whoever reaches it may do everything.",
    ),
]


@contextmanager
def checked_exposure(bus: BusConfig, say: Callable[[str], None], *, insecure: bool) -> Iterator[None]:
    """Refuse, or say each minute while the block runs, that whoever reaches this bus may do everything.

    Raises:
        UsageError: others may reach it, it has no certificates, and it is not to be insecure.
    """
    if bus.security or not any(map(is_beyond_loopback, bus.endpoints)):
        yield
        return
    what = f"bus.endpoint = {bus.endpoint!r}: whoever reaches it can drive the fans, forge samples and silence alarms"
    if not insecure:
        raise UsageError(f"{what}: make certificates (`fantwin certs init`), or accept that with --insecure")
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
