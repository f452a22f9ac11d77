"""How samples are cut into messages changes nothing that the stages of the chain make of them, to the bit."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import cycle
from operator import methodcaller
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from fantwin import pipeline
from fantwin.pipeline.prediction import free_run, tray_integrator
from fantwin.pipeline.prediction.twin_file import TwinFile
from fantwin.pipeline.runtime.stage import Core
from fantwin.schemas.blocks import cut, join
from fantwin.schemas.fields import columns
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Alarm, Grid, Prediction, Raw, Score, ScorerSnapshot
from fantwin.schemas.tacho import Tacho
from fantwin.stages.resampler import ResamplerConfig, ResamplerCore
from tests.support import scored_blocks
from tests.support.clockless_device import NAN, at, raw
from tests.support.integrated_twins import core_of, physical_twin, twin_with_friction, unstable_twin
from tests.support.twin_files import small_hybrid, write_twin

FANS, RATES_HZ = 8, (None, 7.0, 50.0, 100.0, 1000.0)
ROWS_OF_TWIN, ROWS_OF_SCORER = 200, 60
"""how many samples of the grid go on to the twin, and of its predictions to the scorer"""
CONDITIONS = {"supply_voltage_v": 12.0, "temperature_c": 20.0}
STEPS_S = {"dense": 0.001, "sparse": 0.06, "again": 0.0, "earlier": -0.004, "losses": 0.03}
OF_THE_LINE = ("gap", "silence", "another time", "set back", "device restarts", "acquisition restarts", "late session")
OF_THE_FANS = ("missing readings", "dead tacho", "no number", "commands move", "one command unknown", "off", "far out")
WHAT_HAPPENS = ("regular", "jitter", *STEPS_S, *OF_THE_LINE, *OF_THE_FANS, "ticks", "given up")
CallByTime = Callable[[Any], Any]


class ScriptedLink:
    """A link with many disturbances: raw messages of one sample each, and ticks of the host clock in between."""

    def __init__(self, seed: int, clock_us: int | None) -> None:
        self._rng = np.random.default_rng(seed)
        self._clock_us, self._clock_offset_us = clock_us, clock_us or 0
        self._now_s, self._producer, self._device_sequence = 10.0, "a", 0
        self._sequences = {"a": 0}
        self._command = np.full(FANS, 40.0)

    def items(self, what: str, count: int) -> list[Raw | CallByTime]:
        """Messages, and calls of the core by the time of the host between them."""
        chance, newest, now_s = self._rng.uniform, self._producer, self._now_s
        self._command = chance(0, 90, FANS)
        periods_s = [STEPS_S.get(what, 0.01)] * count
        if what == "ticks":
            return [methodcaller("tick", int(at(now_s + k / 10)[0])) for k in range(count)]
        if what == "given up":
            return [methodcaller("publish_until", int(at(now_s + chance(-0.1, 0.3))[0]))]
        if what in ("silence", "gap", "set back"):
            periods_s = [{"silence": chance(0.6, 8.0), "gap": chance(0.101, 0.6), "set back": -chance(1.1, 3.0)}[what]]
        elif what == "device restarts":
            self._clock_offset_us, self._device_sequence, periods_s = -round(now_s * 1e6), 0, [0.5]
        elif what == "acquisition restarts":
            self._producer, periods_s = f"{len(self._sequences)}", [0.01]
            self._device_sequence += count
        elif what == "another time":
            self._producer, periods_s = "z", [self._rng.choice([-60.0, 60.0]), *[0.2] * count]
        elif what == "late session":
            self._producer, periods_s = "a", [-0.05, 0.01]
        made = [self._sample(period_s, what) for period_s in periods_s]
        if what in ("another time", "late session"):
            self._producer = newest
            self._now_s = now_s if what == "another time" else self._now_s
        return [*made]

    def _sample(self, period_s: float, what: str = "regular") -> Raw:
        jitter_s = self._rng.uniform(-0.004, 0.004) if what == "jitter" else 0.0
        self._now_s = max(0.0, self._now_s + period_s + jitter_s)
        speed, command = self._rng.normal(100.0, 3.0, FANS), self._command.copy()
        if what == "missing readings":
            speed[self._rng.random(FANS) < 0.4] = NAN
        if what in ("dead tacho", "no number"):
            speed[1] = NAN if what == "dead tacho" else np.inf
        if what == "commands move":
            command = self._rng.uniform(0, 90, FANS)
        command[:4] = 10.0 if what == "off" else command[:4]
        command[2] = {"far out": 150.0, "one command unknown": NAN}.get(what, command[2])
        self._device_sequence += 1
        sequence = self._sequences[self._producer] = self._sequences.get(self._producer, -1) + 1
        message = raw(at(self._now_s + self._rng.exponential(0.001)), speed[np.newaxis], command[np.newaxis], fans=FANS)
        clock_us = np.array([(round(self._now_s * 1e6) + self._clock_offset_us) % 2**32], np.uint32)
        return replace(
            message,
            header=Header(self._producer, sequence, "t"),
            device_clock_us=clock_us[:0] if self._clock_us is None else clock_us,
            device_sequence=np.array([self._device_sequence % 2**32], np.uint32),
            supply_voltage_v=self._rng.choice([11.9, 12.0, NAN], (1, FANS)).astype(np.float32),
            temperature_c=np.full((1, FANS), 20.0, np.float32),
        )


def in_blocks(items: Iterable[Any], sizes: Iterable[int]) -> Iterator[Any]:
    """Join messages of one producer that follow one another."""
    block: list[Any] = []
    wanted = cycle(sizes)
    size = next(wanted)
    for item in items:
        is_message = not isinstance(item, methodcaller)
        if block and not (is_message and len(block) < size and item.header.producer == block[0].header.producer):
            yield join(block)
            block, size = [], next(wanted)
        if is_message:
            block.append(item)
        else:
            yield item
    if block:
        yield join(block)


def one_by_one(messages: Iterable[Any], seed: int, most: int) -> list[Any]:
    """The first messages, of one sample each, of which a few are lost and a few come again."""
    times = np.random.default_rng(seed).choice([0, 1, 2], most, p=[0.02, 0.96, 0.02]).tolist()
    rows = [cut(message, k, k + 1) for message in messages for k in range(len(message.t_ns))]
    return [row for row, count in zip(rows, times, strict=False) for _ in range(count)]


def same_in_blocks(
    new: Callable[[], Core], items: Sequence[Any], sizes: Sequence[int], kind: type[Grid | Prediction | Score]
) -> list[Any]:
    """What a core makes of items one by one: in blocks it makes the same."""
    outcomes, results = [], []
    for fed in (items, in_blocks(items, sizes)):
        core, made = new(), list[Any]()
        with np.errstate(all="ignore"):
            for item in fed:
                made += item(core) if isinstance(item, methodcaller) else core.step(item)
            problem, counters = core.problem(), dict(core.counters())
            made += core.close()
        of_kind = [message for message in made if isinstance(message, kind)]
        bits = {
            name: np.concatenate([getattr(each, name) for each in of_kind]).tobytes()
            for name, column in columns(kind).items()
            if of_kind and column.by_sample
        }
        events = [repr(message) for message in made if isinstance(message, Alarm)]
        states = [message.state_json for message in made if isinstance(message, ScorerSnapshot)][-1:]
        outcomes.append((bits, events, states, counters, problem))
        results.append(of_kind)
    assert outcomes[0] == outcomes[1], kind.__name__
    return results[0]


@pytest.fixture(scope="module")
def twins(tmp_path_factory: pytest.TempPathFactory) -> list[TwinFile]:
    folder = tmp_path_factory.mktemp("twins")
    files = (
        Path(pipeline.__file__).parent / "demo" / "twin.onnx",
        write_twin(folder / "hybrid.onnx", small_hybrid()),
        write_twin(folder / "air.onnx", conditions=CONDITIONS),
    )
    counting = physical_twin(FANS, tacho=(Tacho(kind="count", window_s=1.0),))
    made = [unstable_twin(FANS, np.inf), twin_with_friction(30.0, FANS), counting]
    return [*made, *(TwinFile.load(file, FANS) for file in files)]


@settings(max_examples=15, deadline=None)
@given(
    happenings=st.lists(st.tuples(st.sampled_from(WHAT_HAPPENS), st.integers(1, 30)), min_size=1, max_size=12),
    seed=st.integers(0, 1000),
    sizes=st.lists(st.integers(1, 64), min_size=1, max_size=4),
    clock_us=st.sampled_from([None, 0, 2**32 - 10_300_000]),
    rate_hz=st.sampled_from(RATES_HZ),
    twin=st.integers(0, 5),
)
@example(  # a former producer becomes the line's again within a message, and its last sample counts
    [("regular", 1), ("another time", 8), ("regular", 160), ("another time", 8)], 1, [64], None, 7.0, 0
)
def test_blocks_of_any_size_give_the_same_grid_predictions_and_decisions(
    twins: list[TwinFile],
    happenings: list[tuple[str, int]],
    seed: int,
    sizes: list[int],
    clock_us: int | None,
    rate_hz: float | None,
    twin: int,
) -> None:
    line, config = ScriptedLink(seed, clock_us), ResamplerConfig(rate_hz=rate_hz)
    items = [item for what, count in happenings for item in line.items(what, count)]
    grids = same_in_blocks(lambda: ResamplerCore(FANS, config), items, sizes, Grid)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(free_run, "START_SAMPLES", 1 + seed % 6)
        patch.setattr(tray_integrator, "HOLD_LIMIT_NS", 50_000_000 * (seed % 11))
        patch.setattr("fantwin.pipeline.tray_scoring.scorer_core.NOT_JUDGED_S", 0.1)
        predicted = one_by_one(grids, seed, ROWS_OF_TWIN)
        predictions = same_in_blocks(lambda: core_of(twins[twin], warm_up_s=0.05), predicted, sizes, Prediction)
        judged = one_by_one(predictions, seed, ROWS_OF_SCORER)
        same_in_blocks(lambda: scored_blocks.core_of(FANS), judged, sizes, Score)
