"""The stage contract: a pure core, the adapters handed to it, and one declaration.

A core sees no bus, clock, file or environment. The runner (or a test, or a replay) passes it one message at a time and
publishes what it returns. The runner is the only loop.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from fantwin.pipeline.config.registry import STAGES
from fantwin.pipeline.config.settings import Config, Section, TrayConfig
from fantwin.pipeline.config.shards import own_file
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.plugins import StageRow
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.health import AcceptedSamples, Learning
from fantwin.schemas.messages import Message, ScorerSnapshot
from fantwin.schemas.topics import ALL_TRAYS, BY_NAME, makes_samples_of_samples


class StageConfig(Section):
    """Base of every stage's section in the configuration file."""


@dataclass(frozen=True, eq=False)
class Admitted:
    """What a core makes of an item before its main work.

    Attributes:
        before: messages to be published first.
        block: what is to be processed; None: nothing.
        key: blocks of several trays with equal keys can be processed in one pass; None: this one alone.
    """

    before: Sequence[Message]
    block: Any = None
    key: Hashable = None


class StageError(UserError):
    """A stage cannot start or continue: one line that says what, where and what to do."""


class Core(Protocol):
    """The pure part of a stage. Only `step` must be implemented; everything else has a neutral default.

    Messages are returned unstamped: the runner sets producer, sequence number, tray and input position. A core that
    serves all trays names the tray of what it returns in the header; without one, a message made by `step` belongs to
    the tray of the input message.
    """

    def step(self, item: Any) -> Sequence[Message]:
        """Process one message (or one item of the stage's source) and return the resulting messages."""
        ...

    def admit(self, item: Any) -> Admitted:
        """The first part of `step`, in a stage that processes the blocks of several trays in one pass (`Stage.joint`).
        The default does all that `step` does."""
        return Admitted(self.step(item))

    def tick(self, now_ns: int) -> Sequence[Message]:
        """Let time pass; called about every 50 ms. now_ns: time of the host, or of the replay that feeds the stage."""
        return ()

    def confirm_input(self, *, is_complete: bool) -> None:
        """Note, before each `tick`, whether the main input is complete: its producer has shown since the last tick that
        all that it has sent has been processed here. If not, the link may be cut, and messages may still come."""

    def close(self) -> Sequence[Message]:
        """Called once after the last item: return what is still held, release adapters."""
        return ()

    def abort(self) -> None:
        """Called instead of `close` when this core raised: release adapters, save nothing.

        The state may be half updated. Without a saved state the restarted stage consumes the failed input again, or
        counts it as lost.
        """

    def counters(self) -> Mapping[str, int]:
        """What the core counts. Names that begin with `lost_` are losses and are summed up in health."""
        return {}

    def unsaved(self) -> Iterable[Envelope]:
        """Messages that a core keeps in memory and that are lost if it is killed now, such as those a recorder has not
        flushed. The default is for cores that have done their work when `step` returns."""
        return ()

    def samples_in(self, item: Any) -> int:
        """How many samples an item of the source holds: so many are lost if there is no time to process it."""
        return 1

    def notes(self) -> Sequence[str]:
        """What the core works with and has done, a line each, for people; nothing that is wrong."""
        return ()

    def learning(self) -> Learning | None:
        """What the first twin of its tray waits for; None: there is one, or it learns none."""
        return None

    def wants(self, tray: str) -> bool:
        """Whether the next message of a tray on an `undecoded` topic is needed: if not, it is not read, and is no loss.
        Called for each message that comes, in a thread of the bus, so that it must never wait."""
        return True

    def accepts(self) -> AcceptedSamples | None:
        """What a client may push to it; None: nothing."""
        return None

    def problem(self) -> str:
        """One line on what is wrong now and what to do; empty when all is well."""
        return ""


class Joint(Protocol):
    """Processes admitted blocks, for one process of a stage."""

    def process(self, cores: Sequence[Any], blocks: Sequence[Any]) -> Sequence[Message]:
        """The message on each core's block; processed alone, it would differ only by rounding.

        Blocks of several cores have equal keys.
        """
        ...


class Source(Protocol):
    """An adapter that brings in items from outside the bus, such as a serial port. It calls `deliver` from its own
    thread."""

    def start(self, deliver: Callable[[Any], None]) -> None:
        """Begin; `deliver` blocks while the stage is behind."""
        ...

    def stop(self) -> None:
        """Deliver what has already arrived, then end. Nothing more is delivered after it returns."""
        ...


class Kept(Protocol):
    """The snapshots that other stages keep: `pipeline.runtime.kept_snapshots`."""

    def of(self, tray: str, *, is_patient: bool) -> tuple[Sequence[ScorerSnapshot], str]:
        """The last one of a tray that each stage keeps, and why there may be others, for people; empty: there are none.
        is_patient: wait for a stage that is not there yet."""
        ...


def never() -> bool:
    """The `Context.is_replayed` of a site without a replay: always False."""
    return False


@dataclass(frozen=True)
class Context:
    """What a stage is built from: its own section, the trays it serves, and where relative paths start."""

    site: str
    trays: tuple[TrayConfig, ...]
    config: Any
    folder: Path
    run_folder: Path
    started_t_ns: int
    instance: str = ALL_TRAYS
    """the name of the process"""
    producer: str = ""
    """with which this process signs what it publishes; empty where it publishes nothing, as in a check"""
    shard_number: int = 1
    """of a numbered shard"""
    snapshot_folder: Path | None = None
    """where a stage keeps the state that survives a restart; None: nothing is kept, as in a replay"""
    kept: Kept | None = field(default=None, repr=False)
    """what others keep of that state; None: nobody is asked"""
    is_replayed: Callable[[], bool] = field(default=never, repr=False)
    """whether a replay presents the site now, so that samples are those of a recording"""
    configuration_path: Path | None = None
    """the configuration file; None: there is none, as in a replay"""
    configuration_text: str = field(default="", repr=False)
    overrides: tuple[str, ...] = ()
    """the keys set on the command line, `key=value`"""
    is_running: bool = False
    """for a check: this stage already runs on this host, and has taken itself what it needs"""
    reads: tuple[str, ...] | None = None
    """the topics that it reads as configured; None: all that its declaration names"""

    @property
    def tray(self) -> TrayConfig:
        """The one tray of a core that serves one tray."""
        (tray,) = self.trays
        return tray

    def own_file(self, path: Path) -> Path:
        """A file of this process in the run folder."""
        return self.run_folder / own_file(self.instance, path)

    def resolve(self, path: Path) -> Path:
        """A path of the configuration file, taken relative to that file."""
        return path if path.is_absolute() else self.folder / path


@dataclass(frozen=True)
class BuiltStage:
    """A built stage.

    Attributes:
        source: feeds the core; None: the bus does.
        kept: messages from before that it keeps for others, by key.
    """

    core: Core
    source: Source | None = None
    kept: Mapping[str, bytes] = field(default_factory=dict)


def no_problems(_context: Context) -> Sequence[str]:
    """The check of a stage that has nothing to check."""
    return ()


@dataclass(frozen=True)
class Stage:
    """The declaration of a stage: what the runner and the launcher need to know, but not how it works.

    Attributes:
        row: that of the registry, with what is known without importing the stage.
        about: one line for people.
        config: model of its section.
        build: builds the core, and its source if it has one.
        core_per_tray: a core for each tray, or one core that serves all trays of the process.
        wants_envelopes: whether `step` is given envelopes instead of messages.
        undecoded: topics whose messages `step` is given as envelopes, of which only the header has been decoded, at the
            next tick, and of which a core may leave out what it does not want (`Core.wants`).
        is_patient: nobody waits for what it does with a message: messages are taken at the next tick, together.
        joint: for cores that process the blocks of several trays in one pass; None: each tray alone.
        check: lists, without side effects, what would keep the stage from working (a missing port, a twin that
            does not fit); one line each. `fantwin doctor` prints them.
        chooses: of the topics in `reads`, those that it reads with this section and these trays of the site.

    Raises:
        ValueError: `reads` or `writes` names an unknown topic.
    """

    row: StageRow
    about: str
    config: type[StageConfig]
    build: Callable[[Context], BuiltStage]
    core_per_tray: bool = True
    wants_envelopes: bool = False
    undecoded: tuple[str, ...] = ()
    is_patient: bool = False
    joint: Callable[[], Joint] | None = None
    check: Callable[[Context], Sequence[str]] = no_problems
    chooses: Callable[[Any, Sequence[TrayConfig]], Sequence[str]] | None = None

    @property
    def name(self) -> str:
        """The name of its row."""
        return self.row.name

    @property
    def reads(self) -> tuple[str, ...]:
        """The topics that it reads; the first is the main input."""
        return self.row.reads

    @property
    def writes(self) -> tuple[str, ...]:
        """The topics that it writes."""
        return self.row.writes

    @property
    def may_drop(self) -> bool:
        """Whether messages that it misses are no losses."""
        return self.row.may_drop

    def __post_init__(self) -> None:
        unknown = [name for name in (*self.reads, *self.writes) if name not in BY_NAME]
        if unknown:
            raise ValueError(f"stage {self.name!r}: no such topic: {', '.join(unknown)}; known: {', '.join(BY_NAME)}")
        for name in self.writes:
            if BY_NAME[name].is_of_session:
                raise ValueError(f"stage {self.name!r}: {name} is published by the runner; take it out of `writes`")

    def reads_as_configured(self, config: Config) -> tuple[str, ...]:
        """The topics that it reads with this configuration, which has its section."""
        return tuple(self.chooses(config.sections[self.name], config.trays)) if self.chooses else self.reads

    @property
    def makes_samples_of_samples(self) -> bool:
        """Whether it makes blocks of samples from its main input: it then reports what it has consumed."""
        return makes_samples_of_samples(self.reads, self.writes)


def load_stage(name: str) -> Stage:
    """Import the stage called `name` and return its declaration.

    Raises:
        KeyError: no such stage.
    """
    stage = STAGES[name].load()
    assert isinstance(stage, Stage)
    return stage
