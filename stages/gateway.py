"""Gateway: the web server of a site: operators' page, API, live events and metrics (docs/how-to/gateway.md).

Reads `score`, `alarm`, `twin`, `health`, and `snapshot` for the wear, and writes `request`. One core serves all trays.
With many fans, about one score a second of each tray is read, and all of those trays that somebody looks at.

The server runs in a thread of its own: it reads what the core has collected, and leaves requests for the core to send.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from functools import partial
from typing import TYPE_CHECKING

from fantwin.pipeline.config.registry import RECORDER, STAGES
from fantwin.pipeline.errors import refusals
from fantwin.pipeline.http_server import HttpServer, listen
from fantwin.pipeline.outputs.web.config import GatewayConfig
from fantwin.pipeline.outputs.web.live_feed import LiveFeed
from fantwin.pipeline.recordings.clips.clip import clip_folder
from fantwin.pipeline.recordings.time_range import RecordedRange
from fantwin.pipeline.runtime.stage import BuiltStage, Context, Stage
from fantwin.pipeline.site.alarm_history import FILE, AlarmHistory
from fantwin.pipeline.site.fan_history import curves_of
from fantwin.pipeline.site.fan_series import FanSeries
from fantwin.pipeline.site.fleet import Fan
from fantwin.pipeline.site.other_stages import VIEWER, configured, expected_stages, recordings_of, viewer_urls
from fantwin.pipeline.site.request_desk import RequestDesk
from fantwin.pipeline.site.site_core import SiteCore
from fantwin.pipeline.site.site_json import alarm_json, curves_json, fleet_json, stages_json
from fantwin.pipeline.site.site_model import SiteModel
from fantwin.schemas.blocks import can_join, join
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.messages import Alarm, Message, Score
from fantwin.schemas.units import NS_PER_S

if TYPE_CHECKING:
    from fantwin.pipeline.certificates import Certificate
    from fantwin.pipeline.outputs.web.access import Access

SAMPLES_PERIOD_NS = NS_PER_S // 5
FLEET_PERIOD_NS = NS_PER_S
STAGES_PERIOD_NS = 2 * NS_PER_S


class GatewayCore(SiteCore):
    """Collects what the server shows, and sends what operators ask."""

    def __init__(
        self,
        model: SiteModel,
        feed: LiveFeed,
        desk: RequestDesk,
        server: HttpServer,
        access: Access,
        certificate: Certificate | None,
    ) -> None:
        """certificate: with which the server shows who it is; None: it serves http."""
        super().__init__(model, desk)
        self._feed, self._server, self._access, self._certificate = feed, server, access, certificate
        self._fleet_ns = self._stages_ns = self._samples_ns = 0
        self._scores: dict[str, list[Score]] = {}
        """by tray: those that are to be sent to the pages that show one of its fans; they differ in samples only"""

    def add_score(self, envelope: Envelope) -> None:
        """Keep it, also for the pages that show one of its fans."""
        score = self._model.add_score(envelope, every_s=self._every_s)
        name = envelope.header.tray
        if score is None or name not in self._feed.looked_at:
            return
        scores = self._scores.setdefault(name, [])
        if scores and not can_join(scores[0], score):
            self._send_samples(name)
        self._scores.setdefault(name, []).append(score)

    def _send_samples(self, name: str) -> None:
        tray, score = self._model.tray(name), join(self._scores.pop(name))
        assert tray, "only scores of known trays are kept"
        for fan in self._feed.looked_at.get(name, ()):
            self._feed.publish("samples", curves_json(curves_of(score, fan), tray), about=(name, fan))

    def add_alarm(self, alarm: Alarm) -> None:
        """Keep it, and send a transition to all pages."""
        is_new = self._model.add_alarm(alarm)
        fan = Fan(alarm.header.tray, alarm.fan)
        current = self._model.current_alarm(fan)
        if is_new and current is not None and self._feed.readers:
            self._feed.publish(
                "alarm", alarm_json(current, self._model.about(fan)) | {"now": self._model.words_now([fan])[0]}
            )

    def tick(self, now_ns: int) -> Sequence[Message]:
        """Send the pages samples and the state of the fleet, and the scorers what operators ask."""
        requests = super().tick(now_ns)
        if abs(now_ns - self._samples_ns) >= SAMPLES_PERIOD_NS:
            self._samples_ns = now_ns
            for name in list(self._scores):
                self._send_samples(name)
        if abs(now_ns - self._fleet_ns) >= FLEET_PERIOD_NS:
            self._fleet_ns = now_ns
            if self._feed.readers:
                self._feed.publish("fleet", fleet_json(self._model))
        if abs(now_ns - self._stages_ns) >= STAGES_PERIOD_NS:
            self._stages_ns = now_ns
            if self._feed.readers:
                self._feed.publish("stages", {"stages": stages_json(self._model.stages())})
        return requests

    def close(self) -> Sequence[Message]:
        """Stop the server, and close the history."""
        self._server.stop()
        return super().close()

    def counters(self) -> Mapping[str, int]:
        """Requests sent, pages that are open, and what could not be shown."""
        return {"pages_open": self._feed.readers, **super().counters()}

    def wants(self, tray: str) -> bool:
        """Whether the next score of a tray is to be decoded: all, of a tray that somebody looks at."""
        return tray in self._feed.looked_at or super().wants(tray)

    def problem(self) -> str:
        """Problem of the server, its certificate, the users and the history."""
        ended = "" if self._server.is_running else "the web server has ended"
        expired = self._certificate.time_problem(datetime.now(UTC)) if self._certificate else ""
        wrong = "; ".join(filter(None, (ended, expired)))
        to_do = wrong and f"{wrong}; restart the gateway"
        return "; ".join(filter(None, (to_do, self._access.problem, super().problem())))


def build(context: Context) -> BuiltStage:
    """Open the history and listen.

    Raises:
        UserError: the port is taken, or a file cannot be read or written.
    """
    from fantwin.pipeline.certificates import read_certificate, server_context  # noqa: PLC0415  slow to import
    from fantwin.pipeline.outputs.web.access import Access  # noqa: PLC0415
    from fantwin.pipeline.outputs.web.api import Api  # noqa: PLC0415
    from fantwin.pipeline.outputs.web.app import MOST_CONNECTIONS, application  # noqa: PLC0415
    from fantwin.pipeline.site.users import Users  # noqa: PLC0415

    alarms = AlarmHistory(context.own_file(FILE))
    if context.started_t_ns:
        alarms.begins(context.started_t_ns)
    model = SiteModel(
        context.site,
        context.trays,
        alarms,
        expected=expected_stages(context),
        keeps_curves=True,
        keeps_rates=True,
    )
    feed, desk = LiveFeed(), RequestDesk(context.producer)
    recorders, viewers = configured(context, RECORDER), configured(context, VIEWER)
    recordings = recordings_of(recorders) if recorders else ()
    clip_folders = tuple(dict.fromkeys(map(clip_folder, recordings)))
    series = FanSeries(model, RecordedRange(recordings) if recordings else None)
    config: GatewayConfig = context.config
    tls = shown = None
    if config.certificate and config.key:
        certificate = context.resolve(config.certificate)
        tls, shown = server_context(certificate, context.resolve(config.key)), read_certificate(certificate)
    access = Access(config, Users(context.resolve(config.users)) if config.users else None)
    listening = listen(config.host, config.port + context.shard_number - 1, "gateway")
    urls = viewer_urls(viewers) if viewers else {}
    app = application(Api(model, access, feed, desk, urls, series, clip_folders), config)
    server = HttpServer(app, listening, tls, MOST_CONNECTIONS, feed.end)
    return BuiltStage(GatewayCore(model, feed, desk, server, access, shown))


def check(context: Context) -> list[str]:
    """Problems with the gateway: its port is taken by another program, or a file cannot be read."""
    from fantwin.pipeline.certificates import check_pair, require_valid  # noqa: PLC0415  slow to import
    from fantwin.pipeline.site.users import read_accounts  # noqa: PLC0415

    config: GatewayConfig = context.config
    attempts: list[Callable[[], object]] = []
    if config.certificate and config.key:
        files = context.resolve(config.certificate), context.resolve(config.key)
        attempts.append(lambda: require_valid(check_pair(*files)))
    if config.users:
        attempts.append(partial(read_accounts, context.resolve(config.users)))
    if not context.is_running and "port" in config.model_fields_set:
        attempts.append(lambda: listen(config.host, config.port + context.shard_number - 1, "gateway").close())
    return refusals(*attempts)


STAGE = Stage(
    row=STAGES["gateway"],
    about="serves the operators' page, the API, live events and metrics by HTTP",
    config=GatewayConfig,
    build=build,
    core_per_tray=False,
    undecoded=("score",),
    check=check,
)
