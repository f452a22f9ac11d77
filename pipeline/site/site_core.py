"""What the cores of all outputs have in common: they keep in a model of the site what arrives."""

from __future__ import annotations

from abc import abstractmethod
from collections import Counter
from collections.abc import Mapping, Sequence

from fantwin.pipeline.runtime.stage import Core
from fantwin.pipeline.site.one_line import readable_alarm, readable_health
from fantwin.pipeline.site.request_desk import RequestDesk
from fantwin.pipeline.site.site_model import SiteModel
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.health import Health
from fantwin.schemas.messages import Alarm, Message, ModelCard, Score, ScorerSnapshot
from fantwin.schemas.units import NS_PER_S

ALL_SAMPLES = 64
"""number of fans up to which all samples are kept; of a larger site, some of each tray"""
SILENCE_PERIOD_NS = NS_PER_S
SAMPLED_S = 0.9
"""least time between two scores of a tray of a larger site that are read: where one comes each second, it is read"""


class SiteCore(Core):
    """Keeps in a model what arrives. Scores arrive as envelopes."""

    def __init__(self, model: SiteModel, desk: RequestDesk | None = None) -> None:
        """desk: of an output by which operators act; None: of one by which nobody does."""
        self._model, self._desk = model, desk or RequestDesk("")
        self._silence_ns = 0
        self._counts: Counter[str] = Counter()
        self._every_s = 0.0 if sum(tray.fans for tray in model.trays) <= ALL_SAMPLES else SAMPLED_S

    def step(self, item: Message | Envelope) -> Sequence[Message]:
        """Keep what has arrived, if it is about a fan of the site or about a stage."""
        if isinstance(item, Health):
            self._model.add_health(readable_health(item))
            return ()
        tray = self._model.tray(item.header.tray)
        if tray is None:
            self._counts["unknown_tray"] += 1
        elif isinstance(item, Envelope):
            if self.wants(tray.name):
                self.add_score(item)
        elif isinstance(item, Score):
            raise TypeError("a stage of a SiteCore declares undecoded=('score',)")
        elif isinstance(item, ModelCard):
            self._model.add_twin(item)
        elif isinstance(item, ScorerSnapshot):
            self._model.add_snapshot(item)
        elif isinstance(item, Alarm):
            if item.fan < tray.fans:
                alarm = readable_alarm(item)
                self.add_alarm(alarm)
                self._desk.add(alarm)
            else:
                self._counts["unknown_fan"] += 1
        return ()

    def tick(self, now_ns: int) -> Sequence[Message]:
        """Notice which trays are silent, and send the scorers what operators ask."""
        if abs(now_ns - self._silence_ns) >= SILENCE_PERIOD_NS:
            self._silence_ns = now_ns
            self._model.notice_silence()
        requests = self._desk.take()
        self._counts["requests_sent"] += len(requests)
        return requests

    def close(self) -> Sequence[Message]:
        """Close the history."""
        self._model.close()
        return ()

    def abort(self) -> None:
        """The same after a crash."""
        self.close()

    def counters(self) -> Mapping[str, int]:
        """Requests sent, and what could not be shown."""
        return {"refused_scores": self._model.refused_scores, **self._counts}

    def problem(self) -> str:
        """Problem of the history; empty if all is well."""
        return self._model.problem()

    def wants(self, tray: str) -> bool:
        """Whether the next score of a tray is to be decoded."""
        return self._model.wants_score(tray, self._every_s)

    @abstractmethod
    def add_score(self, envelope: Envelope) -> None:
        """A score of a known tray has arrived."""

    @abstractmethod
    def add_alarm(self, alarm: Alarm) -> None:
        """A transition of the alarm of a known fan has arrived."""
