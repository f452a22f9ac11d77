"""MQTT: publishes states and alarms to a broker, and passes on requests that come from there (docs/how-to/mqtt.md).

Reads `score`, `alarm` and `health`, and writes `request`. One core serves all trays.

The broker is never waited for: what is retained has one text a topic, transitions of alarms wait on disk, and both are
sent when the broker has room. After each connection all retained topics are published again.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from fantwin.pipeline.config.registry import STAGES
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.extras import require
from fantwin.pipeline.outputs.mqtt.config import MqttConfig
from fantwin.pipeline.outputs.mqtt.fan_states import FanStates
from fantwin.pipeline.outputs.mqtt.home_assistant import OFFLINE, ONLINE, HomeAssistant
from fantwin.pipeline.outputs.mqtt.link import BrokerLink
from fantwin.pipeline.outputs.mqtt.outbox import Outbox, Outgoing, TransitionQueue, text_of
from fantwin.pipeline.outputs.mqtt.requests import Requests
from fantwin.pipeline.outputs.mqtt.topics import Topics
from fantwin.pipeline.runtime.stage import BuiltStage, Context, Stage
from fantwin.pipeline.site.alarm_history import FILE, AlarmHistory
from fantwin.pipeline.site.fleet import Fan
from fantwin.pipeline.site.other_stages import expected_stages, page_address
from fantwin.pipeline.site.request_desk import RequestDesk
from fantwin.pipeline.site.site_core import SiteCore
from fantwin.pipeline.site.site_json import alarm_json, stages_json, transition_json
from fantwin.pipeline.site.site_model import SiteModel
from fantwin.pipeline.sources.mqtt.client import connection_problems, new_client
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.messages import Alarm, Message
from fantwin.schemas.topics import ALL_TRAYS
from fantwin.schemas.units import NS_PER_S
from fantwin.scoring.alarms.alarm_state import is_listed

SETTLED_AFTER_NS = 2 * NS_PER_S
"""time after the start in which alarms of before are heard again, and nothing retained is published"""
KNOWN_AFTER_NS = 10 * NS_PER_S
"""time after the start until a fan of which no alarm was heard has none, and a tray without a score is silent"""
PERIOD_S = 5.0
"""between two states of a fan of which only numbers have changed; a change of state or alarm is published at once"""
MOST_WAITING = 10_000
"""transitions of alarms that wait on disk while the broker is away; beyond that, the oldest are lost"""
CHANGES_PERIOD_NS = NS_PER_S // 2
SITE_PERIOD_NS = 5 * NS_PER_S


def _devices(context: Context, topics: Topics) -> Mapping[str, str]:
    return HomeAssistant(context.config, topics, context.trays, page_address(context)).messages()


class MqttCore(SiteCore):
    """Knows what the broker should have, and what it has."""

    def __init__(
        self,
        context: Context,
        model: SiteModel,
        alarms: AlarmHistory,
        desk: RequestDesk,
        topics: Topics,
        link: BrokerLink,
    ) -> None:
        config: MqttConfig = context.config
        super().__init__(model, desk)
        self._topics, self._link = topics, link
        self._states = FanStates(model)
        self._outbox = Outbox()
        self._history, self._queue = alarms, TransitionQueue(alarms, MOST_WAITING)
        self._requests = Requests(topics, model.trays, config.accept, desk)
        self._devices = _devices(context, topics) if config.home_assistant else {}
        self._numbers: dict[int, int] = {}
        """transitions under way: by the number of the message, that of the transition"""
        self._changed_alarms: set[Fan] = set()
        self._has_news = False
        self._has_devices = False
        self._knows_all = False
        self._session = 0
        self._began_ns: int | None = None
        self._full_ns = self._changes_ns = self._site_ns = -(1 << 62)

    def add_score(self, envelope: Envelope) -> None:
        """Keep it."""
        self._has_news |= self._model.add_score(envelope) is not None

    def add_alarm(self, alarm: Alarm) -> None:
        """Keep it; a new transition waits to be published."""
        self._model.add_alarm(alarm)
        self._queue.notice_new()
        self._changed_alarms.add(Fan(alarm.header.tray, alarm.fan))

    def tick(self, now_ns: int) -> Sequence[Message]:
        """Publish changes while the broker has room, and pass on requests."""
        if self._began_ns is None or now_ns < self._began_ns:
            self._began_ns = now_ns
        if self._link.sessions != self._session:
            self._session = self._link.sessions
            self._outbox.renew()
        self._receive()
        if now_ns - self._began_ns >= SETTLED_AFTER_NS:
            self._update(now_ns, now_ns - self._began_ns >= KNOWN_AFTER_NS)
        self._send()
        return super().tick(now_ns)

    def close(self) -> Sequence[Message]:
        """Send what there is room for, leave the broker, and close the history."""
        self._send()
        self.abort()
        return ()

    def abort(self) -> None:
        """The same after a crash, sending nothing more."""
        self._link.stop(Outgoing(self._topics.status, OFFLINE, is_retained=True))
        self._model.close()

    def counters(self) -> Mapping[str, int]:
        """Counters of what was published, what waits, and what became of requests."""
        return {
            "connections": self._link.sessions,
            "waiting_transitions": self._queue.waiting,
            "waiting_topics": len(self._outbox),
            "lost_transitions": self._queue.lost + self._history.lost,
            "dropped_requests": self._link.dropped_requests,
            **super().counters(),
            **self._requests.counts,
        }

    def problem(self) -> str:
        """Problem of the broker or the history."""
        broker = self._link.problem()
        if broker and self._queue.lost:
            broker += f"; more than {MOST_WAITING} transitions of alarms wait, the oldest are lost"
        return "; ".join(filter(None, (broker, super().problem())))

    def _receive(self) -> None:
        for topic, payload, is_retained in self._link.received():
            if answer := self._requests.take(topic, payload, is_retained=is_retained):
                self._outbox.answer(*answer)
        for answer in self._requests.answers():
            self._outbox.answer(*answer)

    def _update(self, now_ns: int, knows_all: bool) -> None:
        """Put what has changed into the outbox. knows_all: what was not heard so far is not there."""
        if knows_all and not self._knows_all:
            self._knows_all = True
            self._changed_alarms |= {Fan(tray.name, fan) for tray in self._model.trays for fan in range(tray.fans)}
            self._has_news = True
        for fan in self._changed_alarms:
            current = self._model.current_alarm(fan)
            text = text_of(
                alarm_json(current, self._model.about(fan)) if current and is_listed(current.newest) else None
            )
            self._outbox.retain(self._topics.alarm(fan), text, is_urgent=True)
        is_full = abs(now_ns - self._full_ns) >= PERIOD_S * NS_PER_S
        if is_full:
            self._history.save_again()
            self._queue.notice_new()
        is_due = self._has_news and abs(now_ns - self._changes_ns) >= CHANGES_PERIOD_NS
        if is_full or is_due or self._changed_alarms:
            self._full_ns = now_ns if is_full else self._full_ns
            self._changes_ns, self._has_news = now_ns, False
            for fan, state in self._states.changed(is_full=is_full, with_silent=knows_all).items():
                self._outbox.retain(self._topics.state(fan), text_of(state))
        self._changed_alarms.clear()
        if abs(now_ns - self._site_ns) >= SITE_PERIOD_NS:
            self._site_ns = now_ns
            self._update_site()

    def _update_site(self) -> None:
        fans = sum(tray.fans for tray in self._model.trays)
        self._outbox.retain(self._topics.summary, text_of({"fans": fans} | self._model.counts()))
        self._outbox.retain(self._topics.stages, text_of(stages_json(self._model.stages())))
        if not self._has_devices:
            self._has_devices = True
            for topic, text in self._devices.items():
                self._outbox.retain(topic, text)
            self._outbox.retain(self._topics.status, ONLINE, is_urgent=True)

    def _send(self) -> None:
        for message in self._link.acknowledged():
            if (number := self._numbers.pop(message, None)) is not None:
                self._queue.acknowledge(number)
        room = self._link.room()
        for number, alarm in self._queue.take((room + 1) // 2):
            topic = self._topics.transitions(Fan(alarm.header.tray, alarm.fan))
            sent = self._link.publish(Outgoing(topic, text_of(transition_json(number, alarm)), is_retained=False))
            self._numbers[sent] = number
            self._counts["published_transitions"] += 1
            room -= 1
        for message in self._outbox.take(room):
            self._link.publish(message)
            self._counts["published_messages"] += 1


def build(context: Context) -> BuiltStage:
    """Open the history, and begin to connect.

    Raises:
        StageError: the extra is not installed, or a file cannot be read or written.
    """
    config: MqttConfig = context.config
    require("stage mqtt", "outputs", "paho")
    topics = Topics(context.site, context.instance)
    alarms = AlarmHistory(context.own_file(FILE))
    model = SiteModel(context.site, context.trays, alarms, expected=expected_stages(context))
    link = BrokerLink(
        config,
        context.folder,
        topics.client_id,
        Outgoing(topics.status, OFFLINE, is_retained=True),
        [topics.requests(tray.name) for tray in context.trays] if config.accept else [],
    )
    core = MqttCore(context, model, alarms, RequestDesk(context.producer), topics, link)
    link.start()
    return BuiltStage(core)


def check(context: Context) -> list[str]:
    """Report a missing extra, files that cannot be read, and a broker that does not answer."""
    config: MqttConfig = context.config
    try:
        require("stage mqtt", "outputs", "paho")
        client = new_client(config, context.folder)
    except UserError as error:
        return [str(error)]
    unknown = sorted(set(config.home_assistant) - {tray.name for tray in context.trays})
    return [
        *(f"[mqtt] home_assistant: there is no tray {name}" for name in unknown if context.instance == ALL_TRAYS),
        *connection_problems(client, config, f"broker {config.host}:{config.port}"),
    ]


STAGE = Stage(
    row=STAGES["mqtt"],
    about="publishes states and alarms to an MQTT broker, also for Home Assistant, and takes requests from there",
    config=MqttConfig,
    build=build,
    core_per_tray=False,
    undecoded=("score",),
    check=check,
)
