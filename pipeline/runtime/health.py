"""Health messages: built by the runner, published once a second and once more at the end."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Iterable, Mapping

import numpy as np

from schemas.messages import Counter, Health, Input, Message, Output, StageStatus, newest_t_ns
from schemas.streams import stage_losses
from schemas.units import NS_PER_S

_MAX_LATENCIES = 2000


class HealthBuilder:
    """Collects the latencies of a stage's outputs and builds its `Health` messages."""

    def __init__(self, stage: str, instance: str, started_t_ns: int, *, may_drop: bool) -> None:
        self._stage = stage
        self._instance = instance
        self._started_t_ns = started_t_ns
        self._may_drop = may_drop
        self.summary = "starting"
        """the status of the last health in one line"""
        self._latencies_ms: deque[float] = deque(maxlen=_MAX_LATENCIES)

    def add_output(self, message: Message, now_ns: int) -> None:
        """Add the latency of an output: the age of its newest sample when it was published."""
        t_ns = newest_t_ns(message)
        if t_ns:
            self._latencies_ms.append((now_ns - t_ns) / 1e6)

    def build(
        self,
        *,
        status: StageStatus,
        problems: Iterable[str],
        inputs: tuple[Input, ...],
        outputs: Iterable[Output],
        counters: Mapping[str, int],
        now_ns: int,
    ) -> Health:
        """The health message as of now."""
        problem = "; ".join(filter(None, problems))
        if problem and status == StageStatus.OK:
            status = StageStatus.DEGRADED
        p50, p99 = np.percentile(self._latencies_ms, (50, 99)) if self._latencies_ms else (0.0, 0.0)
        self.summary = f"{status.words}: {problem}" if problem else status.words
        return Health(
            stage=self._stage,
            instance=self._instance,
            status=status,
            t_ns=now_ns,
            uptime_s=(now_ns - self._started_t_ns) / NS_PER_S,
            problem=problem,
            inputs=inputs,
            outputs=tuple(outputs),
            counters=tuple(Counter(name=name, value=value) for name, value in sorted(counters.items())),
            latency_p50_ms=float(p50),
            latency_p99_ms=float(p99),
            lost=stage_losses(inputs, counters, may_drop=self._may_drop),
            process_id=os.getpid(),
        )
