"""The viewer's page about the stages: current status, problems, twins in force and recent changes.

The page replaces the previous one and has no place on the time line: stages report in host time, while the samples
may be from a recording of last year.
"""

from __future__ import annotations

import re
from collections import deque
from dataclasses import dataclass

import numpy as np

from fantwin.schemas.enums import StageStatus
from fantwin.schemas.health import Health
from fantwin.schemas.messages import ModelCard
from fantwin.schemas.topics import key_in_words, stage_label

CHANGES_SHOWN = 20
PROBLEM_LENGTH = 200
SILENT_AFTER_NS = 5_000_000_000
INSTANCES_LISTED = 8
"""of a stage with more, those that are well are one row; trays with one twin are one line"""
PROBLEMS_LISTED = 20
INPUTS_NAMED = 3


def markdown_literal(text: str) -> str:
    """Text escaped for Markdown, on one line."""
    return re.sub(r"([\\`*_\[\]<>|#~])", r"\\\1", " ".join(text.split()))


def rounded(count: int) -> str:
    """A count rounded to two digits, so that a growing count changes the page less and less often."""
    return f"{int(float(f'{count:.2g}')):,}"


@dataclass(slots=True)
class _Latest:
    """The latest health of a stage, and when this host first looked at it: clocks of other hosts may differ."""

    health: Health
    seen_ns: int | None = None

    def state(self, now_ns: int) -> str:
        """Its status in one word, or `silent`."""
        if self.seen_ns is None:
            self.seen_ns = now_ns
        status = self.health.status
        if status != StageStatus.STOPPED and now_ns - self.seen_ns > SILENT_AFTER_NS:
            return "silent"
        return status.words


class StagesPage:
    """Collects the health of the stages and renders it in Markdown.

    Its length is bounded: a row for each stage, and for each of its instances that is not well; a line for each twin;
    `PROBLEMS_LISTED` problems and `CHANGES_SHOWN` changes.
    """

    def __init__(self) -> None:
        self._stages: dict[str, _Latest] = {}
        self._twins: dict[str, ModelCard] = {}
        self._changes: deque[str] = deque(maxlen=CHANGES_SHOWN)

    def add_health(self, health: Health) -> None:
        """Store the health of a stage."""
        name = stage_label(health.stage, health.instance)
        before = self._stages.get(name)
        self._stages[name] = _Latest(health)
        text = _describe(health)
        if before is None or text != _describe(before.health):
            self._changes.appendleft(f"- {_time(health.t_ns)} {markdown_literal(name)}: {text}")

    def add_twin(self, tray: str, card: ModelCard) -> None:
        """Store the twin of a tray."""
        self._twins[tray] = card

    def text(self, now_ns: int) -> str:
        """The page at host time `now_ns`. A stage without a new health for `SILENT_AFTER_NS` is silent."""
        rows = ["| stage | state | lost |", "|:--|:--|--:|"]
        problems: list[str] = []
        by_stage: dict[str, list[str]] = {}
        for name in sorted(self._stages):
            by_stage.setdefault(name.partition("/")[0], []).append(name)
        for stage, names in by_stage.items():
            states = {name: self._stages[name].state(now_ns) for name in names}
            well = [name for name in names if states[name] == "ok" and not self._stages[name].health.lost]
            are_many = len(names) > INSTANCES_LISTED
            for name in names:
                if not are_many or name not in well:
                    lost = rounded(self._stages[name].health.lost)
                    rows.append(f"| {markdown_literal(name)} | {_bold(states[name], 'ok')} | {_bold(lost, '0')} |")
                problems += _problems(name, self._stages[name].health, states[name])
            if are_many and well:
                rows.append(f"| {markdown_literal(stage)}: {len(well):,} of {len(names):,} | ok | 0 |")
        if problems[PROBLEMS_LISTED:]:
            problems[PROBLEMS_LISTED:] = [f"- and {len(problems) - PROBLEMS_LISTED:,} more"]
        twins = self._twins_in_force()
        parts = [("Stages now", rows), ("What is wrong", problems), ("Twins in force", twins)]
        parts.append(("Last changes (UTC), newest first", [*self._changes]))
        return "\n\n".join(f"## {title}\n\n" + "\n".join(lines) for title, lines in parts if lines)

    def _twins_in_force(self) -> list[str]:
        by_twin: dict[str, dict[str, ModelCard]] = {}
        for tray, card in sorted(self._twins.items()):
            by_twin.setdefault(f"{markdown_literal(card.twin)} ({markdown_literal(card.kind)})", {})[tray] = card
        lines: list[str] = []
        for twin, cards in by_twin.items():
            if len(cards) > INSTANCES_LISTED:
                since_t_ns = max(card.t_ns for card in cards.values())
                lines.append(f"- {len(cards):,} trays: {twin}, the last since {_time(since_t_ns)}")
            else:
                lines += [
                    f"- {markdown_literal(tray)}: {twin}, since {_time(card.t_ns)}" for tray, card in cards.items()
                ]
        return lines


def _problems(name: str, health: Health, state: str) -> list[str]:
    """What is wrong with an instance, a line each."""
    lines: list[str] = []
    if health.problem and state != "stopped":
        lines.append(f"- **{markdown_literal(name)}**: {_problem(health)}")
    if health.waiting_for and state == StageStatus.OK.words:
        awaited = ", ".join(key_in_words(each.key) for each in health.waiting_for[:INPUTS_NAMED])
        more = len(health.waiting_for) - INPUTS_NAMED
        awaited += f" and {more:,} more" if more > 0 else ""
        lines.append(f"- **{markdown_literal(name)}**: waits for {markdown_literal(awaited)}")
    return lines


def _describe(health: Health) -> str:
    words = health.status.words
    if health.lost:
        words += f", {rounded(health.lost)} lost"
    if health.problem:
        words += f": {_problem(health)}"
    return words


def _problem(health: Health) -> str:
    problem = health.problem
    return markdown_literal(problem if len(problem) <= PROBLEM_LENGTH else f"{problem[:PROBLEM_LENGTH]} ...")


def _bold(word: str, unless: str) -> str:
    return word if word == unless else f"**{word}**"


def _time(t_ns: int) -> str:
    return str(np.datetime64(t_ns, "ns").astype("datetime64[s]")).replace("T", " ")
