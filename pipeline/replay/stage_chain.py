"""The stages between raw samples and scores, derived from what each stage reads and writes."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache

from fantwin.pipeline.config.registry import STAGES
from fantwin.pipeline.runtime.stage import Stage, load_stage
from fantwin.schemas.topics import BY_NAME

SOURCE, RESULT = "raw", "score"


@dataclass(frozen=True)
class StageChain:
    """Stages in the order of the data: the main input of each one is an output of the stage before it."""

    stages: tuple[Stage, ...]
    outputs: tuple[str, ...]
    """of each stage, the topic that the next stage reads; of the last stage, the result"""

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the stages."""
        return tuple(stage.name for stage in self.stages)

    @property
    def side_topics(self) -> tuple[str, ...]:
        """What the last stage reads and writes besides its main input, the result and its summary."""
        last = self.stages[-1]
        others = (topic for topic in last.writes if topic != self.outputs[-1] and not BY_NAME[topic].is_summary)
        return (*last.reads[1:], *others)


def derive_chain(stages: Iterable[Stage], source: str = SOURCE, result: str = RESULT) -> StageChain:
    """The stages that turn `source` into `result`, found backwards from the writer of `result`.

    Raises:
        ValueError: no stage writes a topic on the way, or the stages form a circle.
    """
    writers = {topic: stage for stage in stages for topic in stage.writes}
    chain: list[Stage] = []
    outputs: list[str] = []
    topic = result
    while topic != source:
        stage = writers.get(topic)
        if stage is None or not stage.reads or topic in outputs:
            raise ValueError(f"no stages lead from {source!r} to {result!r}: look at what writes {topic!r}")
        chain.insert(0, stage)
        outputs.insert(0, topic)
        topic = stage.reads[0]
    return StageChain(tuple(chain), tuple(outputs))


def derive_starts(stages: Iterable[Stage]) -> dict[str, tuple[str, ...]]:
    """Where a replay can start: the main input of each stage of the chain, all topics that its writer publishes, and
    those that a stage after it needs first.

    The stages after a start need these topics; they make the later ones themselves.
    """
    stages = tuple(stages)
    writers = {topic: stage for stage in stages for topic in stage.writes}
    chain = derive_chain(stages).stages
    starts = {}
    for number, stage in enumerate(chain):
        after = chain[number:]
        made = {topic for each in after for topic in each.writes}
        needed_first = (topic for each in after for topic in each.reads if BY_NAME[topic].is_needed_first)
        others = (topic for topic in needed_first if topic not in made)
        starts[stage.reads[0]] = tuple(dict.fromkeys((*writers[stage.reads[0]].writes, *others)))
    return starts


@cache
def decision_chain() -> StageChain:
    """The chain of the registered stages."""
    return derive_chain(map(load_stage, STAGES))


@cache
def replay_starts() -> dict[str, tuple[str, ...]]:
    """The starts of the registered stages."""
    return derive_starts(map(load_stage, STAGES))
