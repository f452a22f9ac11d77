"""One list of claims over the stages of the registry.

A row says what the declaration says. A core takes any message of its topics, writes only what it declares, counts and
reports in one line, and makes the same of the same messages.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from fantwin.pipeline.config.registry import STAGES
from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.outputs.mqtt.config import MqttConfig
from fantwin.pipeline.outputs.mqtt.link import Received
from fantwin.pipeline.outputs.mqtt.outbox import Outgoing
from fantwin.pipeline.outputs.mqtt.topics import Topics
from fantwin.pipeline.outputs.notify.config import NotifierConfig
from fantwin.pipeline.outputs.notify.notification_flow import Notifications, Saved
from fantwin.pipeline.outputs.notify.outbox import Outbox
from fantwin.pipeline.outputs.notify.wording import Place
from fantwin.pipeline.outputs.rerun.fleet_view import FleetView
from fantwin.pipeline.outputs.rerun.viewer_core import ViewerCore
from fantwin.pipeline.plugins import StageRow
from fantwin.pipeline.prediction.twin_file import TwinFile
from fantwin.pipeline.runtime.stage import Context, Core, Stage, StageConfig, load_stage
from fantwin.pipeline.site.alarm_history import AlarmHistory
from fantwin.pipeline.site.fleet import Fan
from fantwin.pipeline.site.request_desk import RequestDesk
from fantwin.pipeline.site.site_model import SiteModel
from fantwin.schemas.codec import decode, encode
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.header import Header
from fantwin.schemas.health import Health
from fantwin.schemas.messages import Alarm, Message, Prediction, Score, ScorerSnapshot
from fantwin.schemas.topics import BY_NAME
from fantwin.stages.mqtt import MqttCore
from fantwin.stages.notifier import NotifierCore
from fantwin.stages.resampler import ResamplerConfig, ResamplerCore
from fantwin.stages.twin_integrator import TwinIntegratorConfig, TwinIntegratorCore
from tests.support.drawn_views import FakeSink
from tests.support.made_messages import TOPIC_OF
from tests.support.message_strategies import any_message
from tests.support.scored_blocks import core_of, prediction_of
from tests.support.twin_files import write_twin

FANS = 2
TRAYS = (TrayConfig(name="tray1", fans=FANS),)
NO_SLOW_CHECK = settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.too_slow])


@pytest.mark.parametrize("row", STAGES.values(), ids=str)
def test_the_declaration_of_a_stage_names_its_row(row: StageRow) -> None:
    stage = row.load()
    assert stage.row is row
    assert stage.about and issubclass(stage.config, StageConfig)
    assert set(stage.undecoded) <= set(stage.reads)


def test_no_stage_imports_what_it_can_do_without_until_it_needs_it() -> None:
    load = "import sys; from fantwin.pipeline.config.registry import STAGES; [row.load() for row in STAGES.values()]"
    loaded = subprocess.run(
        [sys.executable, "-c", f"{load}; print(*sys.modules)"], check=True, capture_output=True, text=True
    ).stdout.split()
    assert {"numpy", "fantwin.stages.scorer", "fantwin.stages.twin_integrator"} <= set(loaded)
    assert {"scipy", "torch", "onnxruntime", "rerun", "dask"}.isdisjoint(loaded)


def sessions(*kinds: type[Message]) -> st.SearchStrategy[list[Message]]:
    """Messages as they come off the bus, most of them with the number of fans of the tray."""
    messages = st.one_of(*(any_message(kind, fans=st.sampled_from([FANS, FANS, FANS, 3])) for kind in kinds))
    return st.lists(messages, max_size=6)


def survives(core: Core, stage: Stage, session: Sequence[Message], tray: str = "tray1") -> list[bytes]:
    """Feed a session as the runner does; what it has made, which is of topics that it declares to write."""
    out: list[Any] = []
    with np.errstate(all="ignore"):
        for number, message in enumerate(session):
            stamped = replace(message, header=Header("p", number, tray))
            payload, topic = encode(stamped), TOPIC_OF[type(message)]
            item = Envelope("", topic, payload, 0) if topic in stage.undecoded else decode(type(message), payload)
            out += core.step(item)
            out += core.tick(number * 50_000_000)
            assert "\n" not in core.problem()
            assert all(count >= 0 for count in core.counters().values())
        out += core.close()
    assert {TOPIC_OF[type(message)] for message in out} <= set(stage.writes)
    return [encode(message) for message in out]


@pytest.fixture(scope="module")
def twin(tmp_path_factory: pytest.TempPathFactory) -> TwinFile:
    folder: Path = tmp_path_factory.mktemp("twin")
    return TwinFile.load(write_twin(folder / "twin.onnx", fans=FANS), FANS)


OFTEN: dict[str, Any] = {"declared_per_day": 8640.0}
"""a false alarm in ten seconds: so low a limit that any message may raise one"""

LOOSE = TwinIntegratorConfig(warm_up_s=0.0)
CORES: dict[str, Callable[[TwinFile], Core]] = {
    "resampler": lambda _twin: ResamplerCore(FANS, ResamplerConfig()),
    "twin_integrator": lambda twin: TwinIntegratorCore(twin, LOOSE, 0),
    "scorer": lambda _twin: core_of(FANS, "rpm"),
    "scorer of low limits": lambda _twin: core_of(FANS, "rpm", **OFTEN),
    "viewer": lambda _twin: ViewerCore("site", TRAYS, FakeSink()),
    "viewer of a fleet": lambda _twin: ViewerCore("site", TRAYS, FakeSink(), fleet()),
}


def fleet() -> FleetView:
    return FleetView(TRAYS, [Fan("tray1", 0)], 1, 0, 2_000_000_000)


def all_valid(message: Message) -> Message:
    """A prediction with rising times and valid samples only; the scorer would refuse most others."""
    if not isinstance(message, Prediction):
        return message
    valid, reason = np.ones_like(message.valid), np.zeros_like(message.invalid_reason)
    return replace(message, t_ns=np.sort(message.t_ns), valid=valid, invalid_reason=reason)


@pytest.mark.parametrize("name", CORES)
@settings(NO_SLOW_CHECK, max_examples=10)
@given(data=st.data())
def test_a_core_survives_any_message_of_its_topics_and_makes_the_same_of_the_same(
    name: str, data: st.DataObject, twin: TwinFile
) -> None:
    stage = load_stage(name.split(" ", maxsplit=1)[0])
    session = data.draw(sessions(*(BY_NAME[topic].message for topic in stage.reads)))
    if data.draw(st.booleans()):
        session = [all_valid(message) for message in session]
    tray = "tray1" if not stage.may_drop else data.draw(st.sampled_from(["tray1", "tray1", "elsewhere"]))
    made, again = (survives(CORES[name](twin), stage, session, tray) for _ in range(2))
    assert made == again


@settings(max_examples=12, deadline=None)
@given(
    st.sampled_from([1, 1000, 10_000_000, 1_000_000_000]),
    st.lists(st.tuples(st.floats(allow_nan=True), st.floats(allow_nan=True)), min_size=1, max_size=20),
    st.integers(1, 40),
)
@example(10_000_000, [(0.0, 0.0), (0.0, 1.8e307)], 15)
def test_a_fan_of_any_speed_and_command_is_diagnosed(period_ns: int, values: list, repeats: int) -> None:
    core = core_of(1, **OFTEN)
    samples = np.repeat(np.array(values), repeats, axis=0)
    prediction = prediction_of(np.zeros(len(samples)), period_ns=period_ns)
    arbitrary = replace(
        prediction, measured_speed_rad_s=samples[:, :1], command=samples[:, 1:], torque_balance_command=samples[:, 1:]
    )
    survives(core, load_stage("scorer"), [prediction_of(np.zeros(3), first=-9, period_ns=period_ns), arbitrary])


@settings(max_examples=25, deadline=None)
@given(any_message(ScorerSnapshot))
def test_the_scorer_survives_any_snapshot(memory: ScorerSnapshot) -> None:
    core = core_of(FANS)
    for kept in (memory, replace(memory, twin_sha256="twin")):
        core.restore(kept)
    survives(core, load_stage("scorer"), [prediction_of(np.zeros((3, FANS)))])


@NO_SLOW_CHECK
@given(session=sessions(Alarm))
def test_the_notifier_survives_any_alarm_and_its_outbox_can_be_read_again(session: list[Message]) -> None:
    target = {"name": "hook", "url_file": "hook.url", "quiet_hours": "00:00-12:00"}
    config = NotifierConfig.model_validate({"target": [target]})
    with TemporaryDirectory() as folder:
        outbox = Outbox(Path(folder) / "outbox", ["hook"])
        notifications = Notifications(config, Place("hall"), Saved(is_first=False))
        survives(NotifierCore(config, TRAYS, notifications, outbox, {}), load_stage("notifier"), session)
        left = Outbox(Path(folder) / "outbox", ["hook"])
        left.load()
        left.close()


class FakeLink:
    """A broker that acknowledges everything at once, and sends what it is given."""

    dropped_requests = 0
    sessions = 1

    def __init__(self, received: list[Received]) -> None:
        self._received = received
        self.published: list[Outgoing] = []

    def room(self) -> int:
        return 200

    def publish(self, message: Outgoing) -> int:
        self.published.append(message)
        return len(self.published)

    def acknowledged(self) -> list[int]:
        return [len(self.published)]

    def received(self) -> list[Received]:
        taken, self._received = self._received, []
        return taken

    def problem(self) -> str:
        return ""

    def stop(self, last: Outgoing) -> None:
        self.published.append(last)


@NO_SLOW_CHECK
@given(
    sessions(Score, Alarm, Health),
    st.sampled_from(["tray1", "tray1", "elsewhere"]),
    st.lists(st.tuples(st.sampled_from(["0", "1", "9", "all", "x"]), st.binary() | st.text().map(str.encode))),
)
def test_the_mqtt_stage_survives_any_message_and_request_and_publishes_only_json(
    session: list[Message], tray: str, asked: list[tuple[str, bytes]]
) -> None:
    config = MqttConfig(url="mqtt://broker", accept=("acknowledge",), home_assistant=("tray1",))
    received = [Received(f"fantwin/site/tray1/{fan}/request", payload, is_retained=False) for fan, payload in asked]
    link: Any = FakeLink(received)
    with TemporaryDirectory() as folder:
        store = AlarmHistory(Path(folder) / "alarms.sqlite")
        model = SiteModel("site", TRAYS, store)
        context = Context("site", TRAYS, config, Path(folder), Path(folder), 0)
        core = MqttCore(context, model, store, RequestDesk("p"), Topics("site"), link)
        core.tick(-20_000_000_000)
        survives(core, load_stage("mqtt"), session, tray)
    for message in link.published:
        if message.text not in ("online", "offline"):
            json.loads(message.text, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))
    answers = [message for message in link.published if message.topic.endswith("/answer")]
    assert len(answers) == sum(bool(payload) for _, payload in asked)
