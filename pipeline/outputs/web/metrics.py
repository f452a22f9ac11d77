"""Metrics in the text format of Prometheus, made of what is known when they are asked for.

Those of fans are written here: 5,000 of them take the library a tenth of a second, in which live events are late.

Names follow Prometheus: a prefix, base units, `_total` on counters; revolutions a minute are the accepted exception for
fans. A fan that is not judged has no score, so that an old one does not go on. What is counted begins with zero, so
that Prometheus sees the first one.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from importlib.metadata import version
from itertools import pairwise

import numpy as np
from prometheus_client import CollectorRegistry, ProcessCollector
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily, Metric
from prometheus_client.exposition import generate_latest
from prometheus_client.registry import Collector
from prometheus_client.utils import floatToGoString

from fantwin.pipeline.site.fan_history import DEVIATION, SERIES, in_series
from fantwin.pipeline.site.fleet import Fan
from fantwin.pipeline.site.site_model import SiteModel
from fantwin.pipeline.site.stage_states import AT_WORK, StageState, Word
from fantwin.schemas.channels import CHANNELS
from fantwin.schemas.enums import Severity
from fantwin.schemas.health import LatencyBucket
from fantwin.schemas.units import RAD_S_PER_UNIT
from fantwin.scoring.alarms.alarm_state import is_presented

_PER_RPM = RAD_S_PER_UNIT["rpm"]
_TRAY = ["site", "tray"]
_FAN = [*_TRAY, "fan"]
_STAGE = ["site", "stage"]
_SEVERITIES = (Severity.WARNING, Severity.ALARM)
_MOST_BUCKETS = 64


class SiteMetrics(Collector):
    """Of alarms, stages and the gateway; collected for each scrape."""

    def __init__(self, model: SiteModel, readers: int = 0) -> None:
        """readers: pages that are open."""
        self._model = model
        self._readers = readers

    def collect(self) -> Iterator[Metric]:
        """All families."""
        yield from self._of_alarms()
        yield from self._of_stages(self._model.stages())
        pages = GaugeMetricFamily("fantwin_gateway_pages", "Pages that receive live events.", labels=["site"])
        pages.add_metric([self._model.site], self._readers)
        yield pages
        build = GaugeMetricFamily("fantwin_build_info", "1; the version of fantwin.", labels=["site", "version"])
        build.add_metric([self._model.site, version("fantwin")], 1.0)
        yield build

    def _of_alarms(self) -> Iterable[Metric]:
        of_fan = [*_FAN, "name", "severity"]
        active = GaugeMetricFamily("fantwin_fan_alarm_active", "1: an alarm of this severity is active.", labels=of_fan)
        unacknowledged = GaugeMetricFamily(
            "fantwin_fan_alarm_unacknowledged",
            "1: an alarm of this severity is neither acknowledged nor silenced; it may have cleared.",
            labels=of_fan,
        )
        presented = GaugeMetricFamily(
            "fantwin_alarms_presented", "Alarms that need attention: neither silenced nor dealt with.", labels=["site"]
        )
        fans_in_alarm = GaugeMetricFamily(
            "fantwin_fans_in_alarm", "Fans whose alarm is active and not silenced.", labels=["site"]
        )
        fans_in_alarm.add_metric([self._model.site], self._model.counts()["in_alarm"])
        total = CounterMetricFamily(
            "fantwin_alarms",
            "Alarms that have reached this severity since the gateway started.",
            labels=[*_TRAY, "severity"],
        )
        alarms = self._model.current_alarms()
        for each in alarms:
            alarm = each.newest
            is_open = is_presented(alarm) and not alarm.acknowledged
            of_site = self._model.site, alarm.header.tray
            name = self._model.about(Fan(alarm.header.tray, alarm.fan)).name
            for severity in _SEVERITIES:
                labels = [*of_site, str(alarm.fan), name, severity.name.lower()]
                active.add_metric(labels, float(alarm.active and alarm.severity == severity))
                unacknowledged.add_metric(labels, float(is_open and alarm.severity == severity))
        raised: Counter[tuple[str, str]] = Counter()
        for (tray, _, severity), count in self._model.raised().items():
            raised[tray, severity] += count
        for tray in self._model.trays:
            for severity in _SEVERITIES:
                name = severity.name.lower()
                total.add_metric([self._model.site, tray.name, name], raised[tray.name, name])
        presented.add_metric([self._model.site], sum(is_presented(each.newest) for each in alarms))
        return active, unacknowledged, presented, fans_in_alarm, total

    def _of_stages(self, states: Iterable[StageState]) -> Iterable[Metric]:
        up = GaugeMetricFamily("fantwin_stage_up", "1: the stage is working.", labels=_STAGE)
        degraded = GaugeMetricFamily("fantwin_stage_degraded", "1: the stage reports a problem.", labels=_STAGE)
        uptime = GaugeMetricFamily("fantwin_stage_uptime_seconds", "Time since its process started.", labels=_STAGE)
        lost = CounterMetricFamily(
            "fantwin_stage_lost", "Messages and samples lost since the stage started.", labels=_STAGE
        )
        received = CounterMetricFamily("fantwin_stage_received_messages", "Messages received.", labels=_STAGE)
        published = CounterMetricFamily("fantwin_stage_published_messages", "Messages published.", labels=_STAGE)
        latency = HistogramMetricFamily(
            "fantwin_stage_latency_seconds", "Age of the newest sample in an output when it was sent.", labels=_STAGE
        )
        for state in states:
            labels = [self._model.site, state.label]
            up.add_metric(labels, float(state.word in AT_WORK))
            if state.view is None:
                continue
            health = state.view.health
            degraded.add_metric(labels, float(state.word == Word.DEGRADED))
            uptime.add_metric(labels, round(health.uptime_s, 1))
            lost.add_metric(labels, health.lost)
            received.add_metric(labels, sum(each.received for each in health.inputs))
            published.add_metric(labels, sum(each.published for each in health.outputs))
            if _is_histogram(health.latencies):
                buckets = [(_bound(each.upper_s), float(each.count)) for each in health.latencies]
                latency.add_metric(labels, buckets, health.latency_sum_s)
        return up, degraded, uptime, lost, received, published, latency


def metrics_text(model: SiteModel, readers: int) -> bytes:
    """All metrics now, with those of the process itself."""
    registry = CollectorRegistry(auto_describe=False)
    registry.register(SiteMetrics(model, readers))
    ProcessCollector(registry=registry)
    return "".join((*_of_fans(model), *_of_wear(model))).encode() + generate_latest(registry)


def _of_fans(model: SiteModel) -> Iterator[str]:
    """The newest sample of every fan of the trays that are heard. A fan without a name has no label `name`."""
    labels = {
        tray.name: [
            f'{{fan="{fan}",{_escaped("name", about.name)}site="{model.site}",tray="{tray.name}"}}'
            for fan, about in enumerate(tray.fan)
        ]
        for tray in model.trays
    }
    heard = [tray for tray in model.trays_now() if tray.is_heard]
    columns = {tray.tray: in_series(tray.values, tray.channels).astype(np.float64) for tray in heard}
    for name, about, curve, per_unit, digits in (
        ("fantwin_fan_speed_rpm", "Measured speed.", "measured_speed_rad_s", _PER_RPM, 2),
        ("fantwin_fan_predicted_speed_rpm", "Speed of the healthy twin.", "predicted_speed_rad_s", _PER_RPM, 2),
        ("fantwin_fan_deviation_rpm", "Measured speed minus that of the twin.", DEVIATION, _PER_RPM, 2),
        ("fantwin_fan_command", "Command given, in the unit of the tray.", "command", 1.0, 4),
        ("fantwin_fan_score_ratio", "Score relative to its limit.", "score", 1.0, 4),
        *((f"fantwin_fan_{each.name}", f"Measured {each.label}.", each.name, 1.0, 4) for each in CHANNELS),
    ):
        having = [tray for tray in heard if curve in SERIES[: -len(CHANNELS)] or curve in tray.channels]
        if having or curve in SERIES[: -len(CHANNELS)]:
            yield _head(name, about)
        for tray in having:
            values = (columns[tray.tray][:, SERIES.index(curve)] / per_unit).round(digits).tolist()
            yield from (
                f"{name}{label} {floatToGoString(value)}\n"
                for label, value in zip(labels[tray.tray], values, strict=True)
                if not math.isnan(value)
            )
    yield from _places(model)
    name = "fantwin_fan_scored"
    yield _head(name, "1: the newest sample is judged; 0: it is not, or there is none.")
    judged = {tray.tray: tray.is_judged.tolist() for tray in heard}
    for tray, of_fans in labels.items():
        are_judged = judged.get(tray) or [False] * len(of_fans)
        yield from (f"{name}{label} {is_judged:d}\n" for label, is_judged in zip(of_fans, are_judged, strict=True))


def _places(model: SiteModel) -> Iterator[str]:
    """Where fans are, which is no label of their series: a fan that moves is the same."""
    placed = [(tray.name, fan, about) for tray in model.trays for fan, about in enumerate(tray.fan) if about.place]
    if placed:
        yield _head("fantwin_fan_info", "1: the place of the fan.")
    for tray, fan, about in placed:
        of = f'fan="{fan}",{_escaped("name", about.name)}{_escaped("place", about.place)}'
        yield f'fantwin_fan_info{{{of}site="{model.site}",tray="{tray}"}} 1\n'


def _escaped(label: str, value: str) -> str:
    """A label before others; nothing without a value, which to Prometheus is the same."""
    text = value.replace("\\", r"\\").replace('"', r"\"")
    return f'{label}="{text}",' if value else ""


def _of_wear(model: SiteModel) -> Iterator[str]:
    yield _head(
        "fantwin_fan_wear_ratio", "Slow change of the speed since the fan was new or serviced, as a share of it."
    )
    for row in model.every_wear():
        name = _escaped("name", model.about(Fan(row["tray"], row["fan"])).name)
        labels = f'fan="{row["fan"]}",{name}site="{model.site}",tray="{row["tray"]}"'
        if row["change"] is not None and math.isfinite(row["change"]):
            yield f"fantwin_fan_wear_ratio{{{labels}}} {floatToGoString(round(row['change'], 6))}\n"


def _head(name: str, about: str) -> str:
    return f"# HELP {name} {about}\n# TYPE {name} gauge\n"


def _is_histogram(buckets: Sequence[LatencyBucket]) -> bool:
    """Whether these are buckets as a stage sends them: another program may send what it likes."""
    return (
        0 < len(buckets) <= _MOST_BUCKETS
        and buckets[-1].upper_s == math.inf
        and all(one.upper_s < next_.upper_s and one.count <= next_.count for one, next_ in pairwise(buckets))
    )


def _bound(upper_s: float) -> str:
    return "+Inf" if upper_s == math.inf else repr(upper_s)
