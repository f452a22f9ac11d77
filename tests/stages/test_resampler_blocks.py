"""stages.resampler: the grid never depends on how raw samples are divided into messages."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from itertools import cycle
from operator import methodcaller
from typing import TypeAlias

import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st

from fantwin.schemas.blocks import join
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Grid, Raw
from fantwin.stages.resampler import ResamplerConfig, ResamplerCore
from tests.support.clockless_device import NAN, at, raw

WHAT_HAPPENS = (
    *("regular", "jitter", "dense", "sparse", "losses"),
    *("missing readings", "dead tacho", "no number", "gap", "silence"),
    *(
        "another time",
        "again",
        "earlier",
        "set back",
        "device restarts",
        "acquisition restarts",
        "late session",
        "ticks",
        "given up",
    ),
)


ByTime: TypeAlias = Callable[[ResamplerCore], list[Grid]]


class ScriptedLink:
    """A link with many disturbances: raw messages of one sample each, and ticks of the host clock in between."""

    def __init__(self, seed: int, clock_us: int | None) -> None:
        self._rng = np.random.default_rng(seed)
        self._has_clock = clock_us is not None
        self._clock_offset_us = clock_us or 0
        self._now_s = 10.0
        self._sequences = {"a": 0}
        self._producer = "a"
        self._device_sequence = 0

    def items(self, what: str, count: int) -> list[Raw | ByTime]:
        """Messages, and calls of the core by the time of the host between them."""
        items: list[Raw | ByTime] = []
        if what == "silence":
            items += [self._sample(self._rng.uniform(0.6, 8.0))]
        elif what == "gap":
            items += [self._sample(self._rng.uniform(0.101, 0.6))]
        elif what == "another time":
            newest, now_s, self._producer = self._producer, self._now_s, "z"
            items += [self._sample(self._rng.choice([-60.0, 60.0]))]
            items += [self._sample(0.2) for _ in range(count)]
            self._producer, self._now_s = newest, now_s
        elif what == "set back":
            items += [self._sample(-self._rng.uniform(1.1, 3.0))]
        elif what == "device restarts":
            self._clock_offset_us, self._device_sequence = -round(self._now_s * 1e6), 0
            items += [self._sample(0.5)]
        elif what == "acquisition restarts":
            self._producer = f"{len(self._sequences)}"
            self._device_sequence += count
            items += [self._sample(0.01)]
        elif what == "late session":
            newest, self._producer = self._producer, "a"
            items += [self._sample(-0.05), self._sample(0.01)]
            self._producer = newest
        elif what == "ticks":
            items += [methodcaller("tick", int(at(self._now_s + k / 10)[0])) for k in range(count)]
        elif what == "given up":
            items += [methodcaller("publish_until", int(at(self._now_s + self._rng.uniform(-0.1, 0.3))[0]))]
        else:
            steps_s = {"dense": 0.001, "sparse": 0.06, "again": 0.0, "earlier": -0.004, "losses": 0.03}
            items += [self._sample(steps_s.get(what, 0.01), what) for _ in range(count)]
        return items

    def _sample(self, period_s: float, what: str = "regular") -> Raw:
        jitter_s = self._rng.uniform(-0.004, 0.004) if what == "jitter" else 0.0
        self._now_s = max(0.0, self._now_s + period_s + jitter_s)
        speed = self._rng.normal(0.0, 1.0, 3)
        if what == "missing readings":
            speed[self._rng.random(3) < 0.4] = NAN
        if what in ("dead tacho", "no number"):
            speed[1] = NAN if what == "dead tacho" else np.inf
        self._device_sequence += 1
        sequence = self._sequences[self._producer] = self._sequences.get(self._producer, -1) + 1
        message = raw(
            at(self._now_s + self._rng.exponential(0.001)), speed[np.newaxis], self._rng.normal(size=1), fans=3
        )
        clock_us = np.array([(round(self._now_s * 1e6) + self._clock_offset_us) % 2**32], np.uint32)
        return replace(
            message,
            header=Header(self._producer, sequence, "t"),
            device_clock_us=clock_us if self._has_clock else clock_us[:0],
            device_sequence=np.array([self._device_sequence % 2**32], np.uint32),
            supply_voltage_v=self._rng.choice([11.0, 12.0, NAN], (1, 3)).astype(np.float32),
        )


def in_blocks(items: Iterable[Raw | ByTime], sizes: Iterable[int]) -> Iterable[Raw | ByTime]:
    """Join messages of one producer that follow one another."""
    block: list[Raw] = []
    wanted = cycle(sizes)
    size = next(wanted)
    for item in items:
        is_raw = isinstance(item, Raw)
        if block and not (is_raw and len(block) < size and item.header.producer == block[0].header.producer):
            yield join(block)
            block, size = [], next(wanted)
        if is_raw:
            block.append(item)
        else:
            yield item
    if block:
        yield join(block)


def driven(items: Iterable[Raw | ByTime], **config: float | None) -> tuple[list[bytes], dict[str, int], str]:
    """All columns, to the bit, and the counters and problem of the core."""
    core, grids = ResamplerCore(3, ResamplerConfig.model_validate(config)), []
    with np.errstate(invalid="ignore"):
        for item in items:
            grids += core.step(item) if isinstance(item, Raw) else item(core)
        problem = core.problem()
        grids += core.close()
    names = ("t_ns", "command", "speed_rad_s", "valid", "invalid_reason", "supply_voltage_v")
    columns = [np.concatenate([getattr(grid, name) for grid in grids]).tobytes() for name in names if grids]
    return columns, dict(core.counters()), problem


@settings(max_examples=30, deadline=None)
@given(
    happenings=st.lists(st.tuples(st.sampled_from(WHAT_HAPPENS), st.integers(1, 30)), min_size=1, max_size=12),
    seed=st.integers(0, 1000),
    sizes=st.lists(st.integers(1, 64), min_size=1, max_size=4),
    clock_us=st.sampled_from([None, 0, 2**32 - 10_300_000]),
    rate_hz=st.sampled_from([None, 7.0, 50.0, 100.0, 1000.0]),
)
@example(  # a former producer becomes the line's again within a message, and its last sample counts
    [("regular", 1), ("another time", 8), ("regular", 160), ("another time", 8)], 1, [64], None, 7.0
)
def test_blocks_of_any_size_give_the_same_grid_to_the_bit(
    happenings: list[tuple[str, int]],
    seed: int,
    sizes: list[int],
    clock_us: int | None,
    rate_hz: float | None,
) -> None:
    line = ScriptedLink(seed, clock_us)
    items = [item for what, count in happenings for item in line.items(what, count)]
    single = driven(items, rate_hz=rate_hz)
    assert driven(in_blocks(items, sizes), rate_hz=rate_hz) == single
