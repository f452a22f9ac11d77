"""Metrics in the text format of Prometheus, made of what is known when they are asked for.

Names follow Prometheus: a prefix, base units, `_total` on counters; revolutions a minute are the accepted exception for
fans. A fan that is not judged has no score, so that an old one does not go on.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator

from prometheus_client import CollectorRegistry
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.exposition import generate_latest
from prometheus_client.registry import Collector

from pipeline.launch.site_state import AT_WORK, StageState
from pipeline.presenting.site_model import SiteModel
from schemas.enums import Severity
from schemas.units import RAD_S_PER_UNIT
from scoring.alarms.alarm_flags import is_presented

_PER_RPM = RAD_S_PER_UNIT["rpm"]
_FAN = ["site", "tray", "fan"]
_STAGE = ["site", "stage"]


class SiteMetrics(Collector):
    """Collected anew for each scrape."""

    def __init__(self, model: SiteModel, readers: int = 0) -> None:
        """readers: pages that are open."""
        self._model = model
        self._readers = readers

    def collect(self) -> Iterator[Metric]:
        """All families."""
        yield from self._of_fans()
        yield from self._of_alarms()
        yield from self._of_stages(self._model.stages())
        pages = GaugeMetricFamily("fantwin_gateway_pages", "pages that receive live events", labels=["site"])
        pages.add_metric([self._model.site], self._readers)
        yield pages

    def _of_fans(self) -> Iterable[Metric]:
        speed = GaugeMetricFamily("fantwin_fan_speed_rpm", "measured speed", labels=_FAN)
        predicted = GaugeMetricFamily("fantwin_fan_predicted_speed_rpm", "speed of the healthy twin", labels=_FAN)
        score = GaugeMetricFamily("fantwin_fan_score_ratio", "score relative to its limit", labels=_FAN)
        scored = GaugeMetricFamily("fantwin_fan_scored", "1: the newest sample is judged", labels=_FAN)
        for sample in self._model.newest_samples():
            labels = [self._model.site, sample.tray, str(sample.fan)]
            scored.add_metric(labels, float(sample.is_judged))
            for family, value in (
                (speed, sample.measured_rad_s / _PER_RPM),
                (predicted, sample.predicted_rad_s / _PER_RPM),
                (score, sample.score),
            ):
                if not math.isnan(value):
                    family.add_metric(labels, value)
        return speed, predicted, score, scored

    def _of_alarms(self) -> Iterable[Metric]:
        active = GaugeMetricFamily(
            "fantwin_fan_alarm_active", "1: an alarm of this severity is active", labels=[*_FAN, "severity"]
        )
        presented = GaugeMetricFamily(
            "fantwin_alarms_presented", "alarms that need attention: neither silenced nor dealt with", labels=["site"]
        )
        total = CounterMetricFamily(
            "fantwin_alarms", "alarms that were raised since the gateway began", labels=[*_FAN, "severity"]
        )
        alarms = self._model.current_alarms()
        for each in alarms:
            alarm = each.newest
            for severity in (Severity.WARNING, Severity.ALARM):
                labels = [self._model.site, alarm.header.tray, str(alarm.fan), severity.name.lower()]
                active.add_metric(labels, float(alarm.active and alarm.severity == severity))
        for (tray, fan, severity), count in self._model.raised().items():
            total.add_metric([self._model.site, tray, str(fan), severity], count)
        presented.add_metric([self._model.site], sum(is_presented(each.newest) for each in alarms))
        return active, presented, total

    def _of_stages(self, states: Iterable[StageState]) -> Iterable[Metric]:
        up = GaugeMetricFamily("fantwin_stage_up", "1: the stage is at work", labels=_STAGE)
        lost = CounterMetricFamily("fantwin_stage_lost", "what the stage has lost since it started", labels=_STAGE)
        received = CounterMetricFamily("fantwin_stage_received_messages", "messages received", labels=_STAGE)
        published = CounterMetricFamily("fantwin_stage_published_messages", "messages published", labels=_STAGE)
        latency = GaugeMetricFamily(
            "fantwin_stage_latency_seconds",
            "age of the newest sample of an output when it is sent, over the last 10 s",
            labels=[*_STAGE, "quantile"],
        )
        for state in states:
            labels = [self._model.site, state.label]
            up.add_metric(labels, float(state.word in AT_WORK))
            if state.view is None:
                continue
            health = state.view.health
            lost.add_metric(labels, health.lost)
            received.add_metric(labels, sum(each.received for each in health.inputs))
            published.add_metric(labels, sum(each.published for each in health.outputs))
            latency.add_metric([*labels, "0.5"], health.latency_p50_ms / 1e3)
            latency.add_metric([*labels, "0.99"], health.latency_p99_ms / 1e3)
        return up, lost, received, published, latency


def metrics_text(model: SiteModel, readers: int) -> bytes:
    """All metrics now."""
    registry = CollectorRegistry(auto_describe=False)
    registry.register(SiteMetrics(model, readers))
    return generate_latest(registry)
