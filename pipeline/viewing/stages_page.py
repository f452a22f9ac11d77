"""The viewer's page on the stages: how each is now, what is wrong, which twins are in force, what changed last.

It is one text that takes the place of the one before, and not lines in time: a stage tells of itself in the host's
time, and the samples that are shown may be a recording of last year.
"""

from __future__ import annotations

import re
from collections import deque
from dataclasses import dataclass

import numpy as np

from schemas.messages import Health, ModelCard, StageStatus

CHANGES_SHOWN = 20
PROBLEM_LENGTH = 200
SILENT_AFTER_NS = 5_000_000_000


def markdown_literal(text: str) -> str:
    """Text that Markdown shows as it is, on one line."""
    return re.sub(r"([\\`*_\[\]<>|#~])", r"\\\1", " ".join(text.split()))


def about(count: int) -> str:
    """A count in two digits. One that only grows then changes the page ever more rarely."""
    return f"{int(float(f'{count:.2g}')):,}"


@dataclass(slots=True)
class _Heard:
    """The last a stage said, and the first time this was looked at: the host's here, for clocks of hosts differ."""

    health: Health
    seen_ns: int | None = None

    def state(self, now_ns: int) -> str:
        """Its status in a word, or that it has fallen silent."""
        if self.seen_ns is None:
            self.seen_ns = now_ns
        status = self.health.status
        if status != StageStatus.STOPPED and now_ns - self.seen_ns > SILENT_AFTER_NS:
            return "silent"
        return status.name.lower()


class StagesPage:
    """Remembers what stages say of themselves and writes it out in Markdown. Its length is bounded: a row a stage,
    a line a tray, `CHANGES_SHOWN` changes."""

    def __init__(self) -> None:
        self._stages: dict[str, _Heard] = {}
        self._twins: dict[str, ModelCard] = {}
        self._changes: deque[str] = deque(maxlen=CHANGES_SHOWN)

    def note_health(self, health: Health) -> None:
        """Remember how a stage is."""
        name = health.stage if health.instance == "all" else f"{health.stage}/{health.instance}"
        before = self._stages.get(name)
        self._stages[name] = _Heard(health)
        said = _in_words(health)
        if before is None or said != _in_words(before.health):
            self._changes.appendleft(f"- {_time(health.t_ns)} {markdown_literal(name)}: {said}")

    def note_twin(self, tray: str, card: ModelCard) -> None:
        """Remember which twin a tray has."""
        self._twins[tray] = card

    def text(self, now_ns: int) -> str:
        """The page as of `now_ns`, the host's time: a stage of which nothing new has come for long is silent."""
        rows = ["| stage | state | lost |", "|:--|:--|--:|"]
        problems: list[str] = []
        for name, heard in sorted(self._stages.items()):
            state, literal = heard.state(now_ns), markdown_literal(name)
            lost = about(heard.health.lost)
            rows.append(f"| {literal} | {_stressed(state, 'ok')} | {_stressed(lost, '0')} |")
            if heard.health.problem and state != "stopped":
                problems.append(f"- **{literal}**: {_problem(heard.health)}")
        twins = [
            f"- {markdown_literal(tray)}: {markdown_literal(card.twin)} ({markdown_literal(card.kind)}), "
            f"since {_time(card.t_ns)}"
            for tray, card in sorted(self._twins.items())
        ]
        parts = [("Stages now", rows), ("What is wrong", problems), ("Twins in force", twins)]
        parts.append(("Last changes (UTC), newest first", [*self._changes]))
        return "\n\n".join(f"## {title}\n\n" + "\n".join(lines) for title, lines in parts if lines)


def _in_words(health: Health) -> str:
    words = health.status.name.lower()
    if health.lost:
        words += f", {about(health.lost)} lost"
    if health.problem:
        words += f": {_problem(health)}"
    return words


def _problem(health: Health) -> str:
    problem = health.problem
    return markdown_literal(problem if len(problem) <= PROBLEM_LENGTH else f"{problem[:PROBLEM_LENGTH]} ...")


def _stressed(word: str, unless: str) -> str:
    return word if word == unless else f"**{word}**"


def _time(t_ns: int) -> str:
    return str(np.datetime64(t_ns, "ns").astype("datetime64[s]")).replace("T", " ")
