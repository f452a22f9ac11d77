"""The viewer's page about the stages: current status, problems, twins in force and recent changes.

The page replaces the previous one and has no place on the time line: stages report in host time, while the samples
may be from a recording of last year.
"""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Mapping, Sequence

import numpy as np

from fantwin.pipeline.site.site_state import StageState, Word
from fantwin.schemas.health import Health
from fantwin.schemas.messages import ModelCard
from fantwin.schemas.topics import key_in_words, stage_label

CHANGES_SHOWN = 20
PROBLEM_LENGTH = 200
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


class StagesPage:
    """Collects the health of the stages and renders it in Markdown.

    Its length is bounded: a row for each stage, and for each of its instances that is not well; a line for each twin;
    `PROBLEMS_LISTED` problems and `CHANGES_SHOWN` changes.
    """

    def __init__(self) -> None:
        self._described: dict[str, str] = {}
        self._changes: deque[str] = deque(maxlen=CHANGES_SHOWN)

    def add_health(self, health: Health) -> None:
        """Note what has changed since the last health of the stage."""
        name, text = stage_label(health.stage, health.instance), _describe(health)
        if text != self._described.get(name):
            self._described[name] = text
            self._changes.appendleft(f"- {_time(health.t_ns)} {markdown_literal(name)}: {text}")

    def text(self, states: Sequence[StageState], twins: Mapping[str, ModelCard]) -> str:
        """The page. states: of the stages that were heard; twins: in force, by tray."""
        rows = ["| stage | state | lost |", "|:--|:--|--:|"]
        problems: list[str] = []
        by_stage: dict[str, dict[str, tuple[StageState, Health]]] = {}
        for state in states:
            if state.view is not None:
                by_stage.setdefault(state.stage, {})[state.label] = (state, state.view.health)
        for stage, instances in sorted(by_stage.items()):
            well = [name for name, (state, health) in instances.items() if state.word == Word.OK and not health.lost]
            are_many = len(instances) > INSTANCES_LISTED
            for name, (state, health) in sorted(instances.items()):
                if not are_many or name not in well:
                    lost = _bold(rounded(health.lost), "0")
                    rows.append(f"| {markdown_literal(name)} | {_bold(state.word, Word.OK)} | {lost} |")
                problems += _problems(name, health, state.word)
            if are_many and well:
                rows.append(f"| {markdown_literal(stage)}: {len(well):,} of {len(instances):,} | ok | 0 |")
        if problems[PROBLEMS_LISTED:]:
            problems[PROBLEMS_LISTED:] = [f"- and {len(problems) - PROBLEMS_LISTED:,} more"]
        parts = [("Stages now", rows), ("What is wrong", problems), ("Twins in force", _in_force(twins))]
        parts.append(("Last changes (UTC), newest first", [*self._changes]))
        return "\n\n".join(f"## {title}\n\n" + "\n".join(lines) for title, lines in parts if lines)


def _in_force(twins: Mapping[str, ModelCard]) -> list[str]:
    by_twin: dict[str, dict[str, ModelCard]] = {}
    for tray, card in sorted(twins.items()):
        by_twin.setdefault(f"{markdown_literal(card.twin)} ({markdown_literal(card.kind)})", {})[tray] = card
    lines: list[str] = []
    for twin, cards in by_twin.items():
        if len(cards) > INSTANCES_LISTED:
            since_t_ns = max(card.t_ns for card in cards.values())
            lines.append(f"- {len(cards):,} trays: {twin}, the last since {_time(since_t_ns)}")
        else:
            lines += [f"- {markdown_literal(tray)}: {twin}, since {_time(card.t_ns)}" for tray, card in cards.items()]
    return lines


def _problems(name: str, health: Health, word: Word) -> list[str]:
    """What is wrong with an instance, a line each."""
    lines: list[str] = []
    if health.problem and word != Word.STOPPED:
        lines.append(f"- **{markdown_literal(name)}**: {_problem(health)}")
    if health.waiting_for and word in (Word.OK, Word.WAITING):
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
