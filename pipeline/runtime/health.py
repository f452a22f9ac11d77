"""Health messages: built by the runner, published once a second and once more at the end."""

from __future__ import annotations

import math
import os
import time
from bisect import bisect_left
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import KW_ONLY, InitVar, dataclass
from itertools import accumulate

import numpy as np

from fantwin.schemas.enums import StageStatus
from fantwin.schemas.health import (
    AcceptedSamples,
    AwaitedInput,
    Counter,
    Health,
    Input,
    LatencyBucket,
    Learning,
    Note,
    Output,
)
from fantwin.schemas.streams import stage_losses
from fantwin.schemas.units import NS_PER_S

LATENCY_WINDOW_S = 10.0
"""percentiles are those of the outputs of this long"""
UPPER_S = (0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 30.0, math.inf)
"""of the buckets of the histogram"""
_MAX_IN_WINDOW = 2000


class Latencies:
    """Latencies of the outputs of one stage: the time, s, from the newest sample of an output until it is sent.

    Percentiles are those of the last LATENCY_WINDOW_S; the histogram and the sum are of all since the start.
    """

    def __init__(self) -> None:
        self._newest_s: deque[tuple[float, float]] = deque(maxlen=_MAX_IN_WINDOW)
        """with the time at which each was measured, of a monotonic clock"""
        self._counts = [0] * len(UPPER_S)
        self.sum_s = 0.0
        """of all; one that is negative, because two clocks differ, counts as zero"""

    def add(self, latency_s: float) -> None:
        """An output has been sent."""
        self._newest_s.append((time.monotonic(), latency_s))
        self._counts[bisect_left(UPPER_S, latency_s)] += 1
        self.sum_s += max(0.0, latency_s)

    def clear(self) -> None:
        """What was added until now was no latency."""
        self._newest_s.clear()
        self._counts = [0] * len(UPPER_S)
        self.sum_s = 0.0

    def percentiles_ms(self) -> tuple[float, float]:
        """Median and 99th percentile of the last LATENCY_WINDOW_S; zero if nothing was sent."""
        since_s = time.monotonic() - LATENCY_WINDOW_S
        newest_ms = [latency_s * 1e3 for at_s, latency_s in self._newest_s if at_s >= since_s]
        if not newest_ms:
            return 0.0, 0.0
        p50, p99 = np.percentile(newest_ms, (50, 99))
        return float(p50), float(p99)

    def histogram(self) -> tuple[LatencyBucket, ...]:
        """Of all; empty if nothing was sent."""
        if not any(self._counts):
            return ()
        counts = accumulate(self._counts)
        return tuple(
            LatencyBucket(upper_s=upper_s, count=count) for upper_s, count in zip(UPPER_S, counts, strict=True)
        )


AWAITED_AFTER_NS = 2 * NS_PER_S
"""a stage waits for a main input when it has had nothing of it to process for this long"""


@dataclass
class HealthBuilder:
    """Collects what a stage receives and sends, and builds its `Health` messages.

    main_keys: the keys of the stage's main input. trays: those of the process; none: all of the site.
    """

    stage: str
    instance: str
    started_t_ns: int
    _: KW_ONLY
    may_drop: bool
    main_keys: InitVar[Iterable[str]] = ()
    trays: Sequence[str] = ()
    summary: str = "starting"
    """the status of the last health in one line"""

    def __post_init__(self, main_keys: Iterable[str]) -> None:
        self._latencies = Latencies()
        self._main_input_t_ns = dict.fromkeys(main_keys, self.started_t_ns)
        """by key: when its last message was processed, which a stage that is behind has had for a while"""
        self._newest_input_t_ns = self._newest_output_t_ns = 0

    def add_input(self, key: str, received_t_ns: int, now_ns: int) -> None:
        """A message or an item of the source is processed now, and was received before; key: empty for a source."""
        self._newest_input_t_ns = received_t_ns
        if key in self._main_input_t_ns:
            self._main_input_t_ns[key] = now_ns

    def add_output(self, t_ns: int, sent_t_ns: int, now_ns: int | None) -> None:
        """An output has been sent, with its newest sample at t_ns, 0 if it has none. Its latency is the age of that at
        `now_ns`, if the time is known."""
        self._newest_output_t_ns = sent_t_ns
        if t_ns and now_ns is not None:
            self._latencies.add((now_ns - t_ns) / NS_PER_S)

    def has_caught_up(self) -> None:
        """What was sent until now was made of messages from before the start: its age is no latency."""
        self._latencies.clear()

    def build(
        self,
        *,
        status: StageStatus,
        problems: Iterable[str],
        inputs: tuple[Input, ...],
        outputs: Iterable[Output],
        counters: Mapping[str, int],
        now_ns: int,
        notes: Iterable[Note] = (),
        accepts: Iterable[AcceptedSamples] = (),
        learning: Iterable[Learning] = (),
    ) -> Health:
        """The health message as of now."""
        problem = "; ".join(filter(None, problems))
        if problem and status == StageStatus.OK:
            status = StageStatus.DEGRADED
        p50_ms, p99_ms = self._latencies.percentiles_ms()
        self.summary = f"{status.words}: {problem}" if problem else status.words
        return Health(
            stage=self.stage,
            instance=self.instance,
            status=status,
            t_ns=now_ns,
            uptime_s=(now_ns - self.started_t_ns) / NS_PER_S,
            problem=problem,
            inputs=inputs,
            outputs=tuple(outputs),
            counters=tuple(Counter(name=name, value=value) for name, value in sorted(counters.items())),
            latency_p50_ms=p50_ms,
            latency_p99_ms=p99_ms,
            latencies=self._latencies.histogram(),
            latency_sum_s=self._latencies.sum_s,
            lost=stage_losses(inputs, counters, may_drop=self.may_drop),
            process_id=os.getpid(),
            waiting_for=tuple(
                AwaitedInput(key=key, since_t_ns=since_t_ns)
                for key, since_t_ns in self._main_input_t_ns.items()
                if now_ns - since_t_ns > AWAITED_AFTER_NS
            ),
            newest_input_t_ns=self._newest_input_t_ns,
            newest_output_t_ns=self._newest_output_t_ns,
            notes=tuple(notes),
            trays=",".join(self.trays),
            accepts=tuple(accepts),
            learning=tuple(learning),
        )
