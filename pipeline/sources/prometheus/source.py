"""Fans whose values a Prometheus has, or an exporter shows.

Prometheus is asked for the samples of the last scrapes, so that none is lost between two requests. The time of a
reading is that of the scrape of its speeds, and each scrape is one reading: a value that was not scraped again is no
new one. A command or another value counts for the speeds that follow it within two scrape intervals. What an exporter
shows has the time of the request, unless the exporter gives one.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from itertools import pairwise

from fantwin.pipeline.errors import refusals
from fantwin.pipeline.sources.named_values import SPEED, NamedValuesSource
from fantwin.pipeline.sources.polling import MOST_FAILURES, DeviceError
from fantwin.pipeline.sources.prometheus.config import PrometheusConfig, labels_of
from fantwin.pipeline.sources.prometheus.server import Samples, Series, period_number, server_of
from fantwin.pipeline.sources.source import Noted, ReadingBatch, Rejected, SourceContext
from fantwin.pipeline.timebase.host_clock import HOST_CLOCK
from fantwin.schemas.units import NS_PER_S

LATER = 0.01
"""part of a period after its begin at which a poll is due"""
LATE = Rejected(
    "late_sample",
    "a speed comes after those of other fans that were measured later: make a tray of the fans of each target",
    setting="source.fan",
)


class PrometheusSource(NamedValuesSource):
    """A `SampleSource`."""

    def __init__(self, config: PrometheusConfig, context: SourceContext) -> None:
        """Ask nothing yet."""
        super().__init__(config, context)
        self._config = config
        self._series: dict[str, Series] = {
            name: tuple(sorted({**config.labels, **labels_of(name)}.items())) for name in self.names()
        }
        self._server = server_of(config, context.folder)
        self._server.want(self._series.values())
        self._speeds = self.names(SPEED)
        self._newest_t_ns = 0
        self._seen: dict[str, int] = {}
        """time of the newest sample of each speed"""

    @property
    def name(self) -> str:
        """The server."""
        parts = self._config.parts
        return f"{parts.scheme}://{parts.netloc.rpartition('@')[2]}{parts.path.rstrip('/')}{self._config.scrape}"

    def connect(self) -> None:
        """Read the credentials; whether the server is there is seen when it is read."""
        self._server.connect()

    def read(self) -> Sequence[ReadingBatch]:
        """What is new: readings with the times of Prometheus."""
        found = self._found()
        speeds = {name: [t_ns for t_ns, value in found.get(name, ()) if not math.isnan(value)] for name in self._speeds}
        times = sorted(set().union(*speeds.values()))
        if not times:
            since = "" if self._config.scrape else f" in {MOST_FAILURES * self._config.period_s:g} s"
            labels = ",".join(f'{name}="{value}"' for name, value in self._series[self._speeds[0]])
            why = f"no sample of {{{labels}}}{since}, nor of other speeds: look for it there, correct source.fan"
            raise DeviceError(why)
        newest_t_ns = self._newest_t_ns or times[-1] - 1  # those before may have been delivered before a restart
        late = sum(
            self._seen.get(name, newest_t_ns) < t_ns <= newest_t_ns for name, each in speeds.items() for t_ns in each
        )
        self._seen |= {name: each[-1] for name, each in speeds.items() if each}
        self._newest_t_ns = max(times[-1], newest_t_ns)
        batches = [
            ReadingBatch(t_ns, (self.reading({name: self._value(name, each, t_ns) for name, each in found.items()}),))
            for t_ns in times
            if t_ns > newest_t_ns
        ]
        noted = (*(LATE,) * late, *_of_other_clock(times[-1], self._config.period_s))
        return [*batches, ReadingBatch(self._newest_t_ns, noted)] if noted else batches

    def disconnect(self) -> None:
        """Do nothing: no connection is kept."""

    def check(self) -> list[str]:
        """Problems before the start: a secret cannot be read. The server is not asked."""
        return refusals(self._server.connect)

    def _began_s(self) -> float:
        """The begin of a period, a little later: all trays get one answer while it is new."""
        period_s = self._config.period_s
        return (period_number(period_s) + LATER) * period_s

    def _found(self) -> dict[str, Samples]:
        """The samples of each series. Raises DeviceError: two series for one at the same time."""
        answer = self._server.answer()
        found: dict[str, Samples] = {}
        for name, series in self._series.items():
            each = sorted(answer.get(series, ()), key=lambda samples: samples[0][0])
            if any(later[0][0] <= earlier[-1][0] for earlier, later in pairwise(each)):
                raise DeviceError(f"several series are {name}: add a label in which they differ")
            if each:  # one after the other, where a label such as the health of the fan has changed
                found[name] = [sample for samples in each for sample in samples]
        return found

    def _value(self, name: str, samples: Samples, t_ns: int) -> float:
        """The newest value up to a time, that of a speed only if it is of this time; NaN where there is none."""
        row = bisect_right(samples, (t_ns, math.inf)) - 1
        oldest_t_ns = t_ns if name in self._speeds else t_ns - round(2.0 * self._config.period_s * NS_PER_S)
        return samples[row][1] if row >= 0 and samples[row][0] >= oldest_t_ns else math.nan


def _of_other_clock(newest_t_ns: int, period_s: float) -> Iterator[Noted]:
    """What to say of a server whose newest sample has a time that cannot be, or long ago."""
    age_s = (HOST_CLOCK.now_ns() - newest_t_ns) / NS_PER_S
    if not -1.0 < age_s < MOST_FAILURES * period_s + 1.0:
        age = f"{age_s:.0f} s old" if age_s > 0 else f"of {-age_s:.0f} s later than now"
        yield Noted("clock_differs", f"its newest sample is {age}: are the clocks of both computers set by NTP?")
