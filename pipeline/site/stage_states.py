"""The state of every stage that a site should have: a stage that is missing, silent, starved or late is a state too.

A stage's own report is not enough: a stage that hangs reports nothing, and one that receives nothing sees nothing
wrong. So a stage's state also depends on when it was last heard, on what its producers say they have sent, and on the
age of its outputs.

Stages also note what they work with and have done: the rate of a grid, gaps, what was not judged and why.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from enum import StrEnum

from fantwin.pipeline.config.registry import STAGES
from fantwin.pipeline.config.shards import StageProcess
from fantwin.pipeline.site.loss_accounting import label, trays_of
from fantwin.pipeline.timebase.stage_clock import REPLAY
from fantwin.schemas.enums import StageStatus
from fantwin.schemas.health import Health
from fantwin.schemas.streams import input_streams, output_streams
from fantwin.schemas.topics import ALL_TRAYS, HEALTH_CHUNK, key_in_words
from fantwin.schemas.units import NS_PER_S


def note_lines(healths: Iterable[Health]) -> list[str]:
    """A line for each note, for people."""
    return [
        f"{', '.join(filter(None, (label(health), note.tray)))}: {note.text}"
        for health in healths
        for note in health.notes
    ]


def notes_as_json(health: Health) -> list[dict[str, str]]:
    """The same of one stage, for machines."""
    return [{"tray": note.tray, "text": note.text} for note in health.notes]


START_LIMIT_S = 60.0
"""silence while a stage starts: it may load large libraries and ask others for what it missed"""
SILENT_AFTER_S = 5.0
"""time without a health message, which every stage sends once a second"""
STARVED_AFTER_S = 5.0
LATE_AFTER_S = 5.0
WHY_SILENT = "it hangs, is blocked or gets no processor time"


class Word(StrEnum):
    """The state of a stage in one word."""

    OK = "ok"
    STARTING = "starting"
    DEGRADED = "degraded"
    WAITING = "waiting"
    LATE = "late"
    STARVED = "starved"
    SILENT = "silent"
    STOPPED = "stopped"
    GONE = "gone"
    MISSING = "missing"


OFF_THE_BUS = {Word.GONE, Word.MISSING}
AT_WORK = {Word.OK, Word.STARTING, Word.DEGRADED, Word.WAITING}
"""in any other state a stage does not do what the configuration asks for"""


@dataclass(frozen=True)
class StageView:
    """A stage session as seen from outside."""

    health: Health
    previous: Health | None
    alive: bool
    age_s: float = 0.0
    """since the health was heard here: clocks of other hosts may differ"""

    @property
    def rate_in_hz(self) -> float:
        """Messages received a second between the last two health messages."""
        return self._rate(sum(i.received for i in self.health.inputs), lambda h: sum(i.received for i in h.inputs))

    @property
    def rate_out_hz(self) -> float:
        """Messages published a second between the last two health messages."""
        return self._rate(sum(o.published for o in self.health.outputs), lambda h: sum(o.published for o in h.outputs))

    def _rate(self, now: int, count: Callable[[Health], int]) -> float:
        if self.previous is None or self.health.t_ns <= self.previous.t_ns:
            return 0.0
        return (now - count(self.previous)) / ((self.health.t_ns - self.previous.t_ns) / NS_PER_S)


@dataclass(frozen=True, slots=True)
class HeardHealth:
    """The last health of a session, the one before, and when the last was heard, of a monotonic clock in s."""

    health: Health
    previous: Health | None
    heard_s: float

    def view(self, now_s: float, *, alive: bool) -> StageView:
        """The session as it is seen now."""
        return StageView(self.health, self.previous, alive, now_s - self.heard_s)


@dataclass(frozen=True)
class StageState:
    """The state of one stage.

    Attributes:
        label: its name for people.
        word: the state in one word.
        detail: what is wrong, in one line; empty if nothing is, or if the stage says it itself as its problem.
        view: its last session; None if it has not been heard.
        is_expected: whether the configuration asks for it.
        trays: those that it has; none: all of the site.
    """

    label: str
    word: Word
    detail: str
    view: StageView | None
    is_expected: bool
    trays: tuple[str, ...] = ()

    @property
    def stage(self) -> str:
        """Whose process it is."""
        return self.label.partition("/")[0]

    def has(self, tray: str) -> bool:
        """Whether it has a tray."""
        return not self.trays or tray in self.trays

    @property
    def problem(self) -> str:
        """What the stage itself says is wrong, while it is alive; empty if nothing is."""
        return self.view.health.problem if self.view and self.view.alive else ""

    @property
    def is_fault(self) -> bool:
        """Whether the site lacks a stage that the configuration asks for, or its work."""
        return self.is_expected and self.word not in AT_WORK


def stage_states(
    views: Sequence[StageView], alive: Iterable[tuple[str, str]], expected: Iterable[StageProcess]
) -> list[StageState]:
    """A state for each process that is expected, in the order of the data flow, and for each other that was heard.

    A process is not missing if others, which were started with other shards, have all of its trays.

    views: the latest session of each stage; alive: stage and instance of the sessions that are on the bus now.
    """
    alive = set(alive)
    by_name = {(view.health.stage, view.health.instance): view for view in views}
    is_replayed = (REPLAY, ALL_TRAYS) in alive
    states: list[StageState] = []
    in_its_place: set[str] = set()
    """stages of which other processes have the trays of one that is expected"""
    for row in expected:
        name = (row.stage, row.instance)
        view = by_name.pop(name, None)
        if view is not None:
            states.append(_state_of(view, views, is_expected=True))
            continue
        trays = () if row.shard.is_whole else row.shard.trays
        if name in alive:
            why = f"on the bus, but sends no health: it is still starting, or {WHY_SILENT}"
            states.append(StageState(row.label, Word.SILENT, why, None, is_expected=True, trays=trays))
        elif is_replayed and STAGES[row.stage].scope == "tray":
            pass  # the replay plays what it would send
        elif _have_all(row, views):
            in_its_place.add(row.stage)
        else:
            states.append(StageState(row.label, Word.MISSING, "not seen on the bus", None, True, trays))
    return states + [
        _state_of(view, views, is_expected=view.alive and view.health.stage in in_its_place)
        for _, view in sorted(by_name.items())
    ]


def _have_all(row: StageProcess, views: Sequence[StageView]) -> bool:
    """Whether processes of a stage have all trays of another one that is not there."""
    alive = [view.health for view in views if view.alive and view.health.stage == row.stage]
    trays = [trays_of(health) for health in alive]
    return bool(trays) and (() in trays or set(row.shard.trays) <= {tray for each in trays for tray in each})


def _state_of(view: StageView, views: Sequence[StageView], *, is_expected: bool) -> StageState:
    word, detail = _judged(view, views)
    return StageState(label(view.health), word, detail, view, is_expected, trays_of(view.health))


def _judged(view: StageView, views: Sequence[StageView]) -> tuple[Word, str]:
    health = view.health
    is_starting = health.status == StageStatus.STARTING  # its liveliness token follows once it has caught up
    if health.status == StageStatus.STOPPED:
        return Word.STOPPED, "stopped in order"
    if not view.alive and not is_starting:
        return Word.GONE, f"left the bus without stopping; last heard {view.age_s:.0f} s ago"
    behind_s = _behind_s(view)
    before = f"; before, it was {behind_s:.0f} s behind" if behind_s > LATE_AFTER_S else ""
    if view.age_s > (START_LIMIT_S if is_starting else SILENT_AFTER_S):
        return Word.SILENT, f"no health for {view.age_s:.0f} s: {WHY_SILENT}{before}"
    return _state_of_work(view, views)


def _state_of_work(view: StageView, views: Sequence[StageView]) -> tuple[Word, str]:
    """The state of a stage that is heard."""
    health = view.health
    if starving := _starving(health, views):
        return Word.STARVED, starving
    if health.status != StageStatus.STARTING:  # it catches up
        if (behind_s := _behind_s(view)) > LATE_AFTER_S:
            return Word.LATE, f"it is {behind_s:.0f} s behind: it processes what it received {behind_s:.0f} s ago"
        if (age_s := health.latency_p50_ms / 1e3) > LATE_AFTER_S:
            return Word.LATE, f"its outputs are {age_s:.0f} s old when they are sent"
    if health.waiting_for and health.status == StageStatus.OK:
        return Word.WAITING, waiting_text(health)
    words = {StageStatus.STARTING: Word.STARTING, StageStatus.OK: Word.OK, StageStatus.DEGRADED: Word.DEGRADED}
    return words.get(health.status, Word.DEGRADED), ""


def _behind_s(view: StageView) -> float:
    """How long what a stage has processed since the health before had waited for it, s; 0 if there was nothing."""
    health, before = view.health, view.previous
    if before is None or _processed(health) <= _processed(before):
        return 0.0
    return (health.t_ns - health.newest_input_t_ns) / NS_PER_S


def _processed(health: Health) -> int:
    """Messages, without the health of other stages: it is no work."""
    return sum(each.received for each in health.inputs if each.key.split("/")[2:3] != [HEALTH_CHUNK])


def waiting_text(health: Health) -> str:
    """Which inputs a stage waits for, and for how long."""
    waits = [(health.t_ns - each.since_t_ns, key_in_words(each.key)) for each in health.waiting_for]
    return f"waits for {', '.join(name for _, name in waits)}, for {min(waits)[0] / NS_PER_S:.0f} s" if waits else ""


def _starving(health: Health, views: Sequence[StageView]) -> str:
    """Which input a stage does not receive although its producer has sent it for a while; empty if none."""
    received = {stream: state.next_sequence or 0 for stream, state in input_streams(health).items()}
    awaited = {each.key: (health.t_ns - each.since_t_ns) / NS_PER_S for each in health.waiting_for}
    for view in views:
        before = view.previous
        if before is None or not view.alive or before.t_ns > health.t_ns:
            continue  # what a line sends that has just been connected is still on the way
        for stream, count in output_streams(before).items():  # sent a second ago or earlier
            seconds = awaited.get(stream[0], 0.0)
            if seconds > STARVED_AFTER_S and count > received.get(stream, 0):
                return (
                    f"received no {key_in_words(stream[0])} for {seconds:.0f} s, although {label(view.health)} sends it"
                )
    return ""
