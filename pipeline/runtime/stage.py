"""What a stage is: a pure core, the adapters it is handed, and one declaration.

A core sees no bus, no clock, no file and no environment: the runner (or a test, or a replay) hands it
messages one at a time and takes what it returns. The runner is the only loop.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Protocol

from pydantic import BaseModel, ConfigDict

from pipeline.config.models import TrayConfig
from pipeline.errors import UserError
from schemas.messages import Message


class StageConfig(BaseModel):
    """Base of every stage's section in the configuration file: frozen, unknown keys refused."""

    model_config: ClassVar[ConfigDict] = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class StageError(UserError):
    """A stage cannot start or go on: one line that says what, where and what to do."""


class Core(Protocol):
    """The pure part of a stage. Only `step` has to be written; the rest has a neutral default."""

    def step(self, item: Any) -> Sequence[Message]:
        """Take one message (or one item of the stage's source) and return what follows from it, unstamped."""
        ...

    def tick(self, now_ns: int) -> Sequence[Message]:
        """Called about every 50 ms; `now_ns` is the host's time, or a replay's while one feeds the stage."""
        return ()

    def close(self) -> Sequence[Message]:
        """Called once after the last item: hand out what is still held, let go of adapters."""
        return ()

    def counters(self) -> Mapping[str, int]:
        """What the core counts. Names that begin with `lost_` are losses and are summed up in health."""
        return {}

    def problem(self) -> str:
        """One line on what is wrong now and what to do; empty when all is well."""
        return ""


class Source(Protocol):
    """An adapter that brings items in from outside the bus (a serial port): calls `deliver` from its own thread."""

    def start(self, deliver: Callable[[Any], None]) -> None:
        """Begin; `deliver` blocks while the stage is behind."""
        ...

    def stop(self) -> None:
        """Deliver what has already arrived, then end. Returns when nothing more will be delivered."""
        ...


@dataclass(frozen=True)
class Context:
    """What a stage is built from: its own section, the trays it serves, and where relative paths start."""

    site: str
    trays: tuple[TrayConfig, ...]
    config: Any
    folder: Path
    run_folder: Path
    started_t_ns: int
    snapshot_folder: Path | None = None
    """where a stage keeps what a restart must not forget; None: nothing is kept, as in a replay"""
    configuration_text: str = field(default="", repr=False)
    overrides: tuple[str, ...] = ()
    """the keys set on the command line, `key=value`"""

    @property
    def tray(self) -> TrayConfig:
        """The one tray of a core that serves one tray."""
        (tray,) = self.trays
        return tray

    def resolve(self, path: Path) -> Path:
        """A path of the configuration file, taken relative to that file."""
        return path if path.is_absolute() else self.folder / path


@dataclass(frozen=True)
class Parts:
    """A built stage: the core, and the source that feeds it, if it has one."""

    core: Core
    source: Source | None = None


def no_problems(_context: Context) -> Sequence[str]:
    """The check of a stage that has nothing to check."""
    return ()


@dataclass(frozen=True)
class Stage:
    """The declaration of a stage: what the runner and the launcher need to know, and nothing of how it works.

    The first topic of `reads` is the main input: outputs say how far it had been taken (`Cause`); others come aside.
    `check` looks, without side effects, for what would keep the stage from working (a missing port, a twin that
    does not fit) and gives one line each; `fantwin doctor` prints them.
    """

    name: str
    about: str
    reads: tuple[str, ...]
    writes: tuple[str, ...]
    config: type[StageConfig]
    build: Callable[[Context], Parts]
    core_per_tray: bool = True
    process_per_tray: bool = False
    wants_envelopes: bool = False
    may_drop: bool = False
    check: Callable[[Context], Sequence[str]] = no_problems
