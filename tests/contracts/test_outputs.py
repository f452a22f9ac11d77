"""One list of claims over every output: page, metrics, OPC UA, MQTT, notifier and viewer show the same alarms."""

from __future__ import annotations

import asyncio
import itertools
import json
import re
import shutil
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import pytest
from asyncua.client.client import Client as OpcuaClient
from prometheus_client.parser import text_string_to_metric_families

from fantwin.pipeline.outputs.notify.config import NotifierConfig
from fantwin.pipeline.outputs.rerun.viewer_core import FLUSH_PERIOD_NS, ViewerCore
from fantwin.schemas.enums import FanState, Severity, Transition
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Alarm, Message, Score
from fantwin.schemas.topics import tray_key
from fantwin.schemas.units import NS_PER_S
from tests.support.drawn_views import FakeSink
from tests.support.message_receivers import HttpReceiver
from tests.support.mosquitto import Mosquitto, retained_by
from tests.support.notified_alarms import START_NS, notifier_core, secret
from tests.support.running_chain import eventually
from tests.support.running_core import FANS, SITE, TRAY, Fans, tray_of
from tests.support.running_gateway import Client, RunningGateway
from tests.support.running_mqtt import ROOT, RunningMqtt
from tests.support.running_opcua import RunningOpcua
from tests.support.score_data import one_sample
from tests.support.site_messages import NOW_NS, alarm, score

Alarms = dict[int, tuple[bool, bool]]
"""fans with an active alarm: whether it is acknowledged, and whether it is silenced"""


class Output:
    """A running output of a site of one tray of `FANS` fans."""

    keeps_state = True
    """whether its reader sees acknowledgements and silenced fans; otherwise it hears events only"""
    running: Any

    def named(self) -> str:
        """All that its reader sees of fan 2, which has a name."""
        raise NotImplementedError

    def feed(self, *messages: Message) -> None:
        """Pass messages, as the runner does."""
        self.running.feed(*messages)

    def alarms(self) -> Alarms:
        """What its reader sees."""
        raise NotImplementedError

    def refused(self) -> int:
        """How many messages it has counted as not usable."""
        names = ("unknown_tray", "unknown_fan", "refused_scores", "wrong_fan_count", "undecodable")
        counters = self.running.counters()
        return sum(counters.get(name, 0) for name in names)

    def close(self) -> None:
        """End it; once, however often it is called."""
        self.running.close()


class GatewayOutput(Output):
    """The operators' page, by its API."""

    def __init__(self, folder: Path, fans: Fans = FANS) -> None:
        self.running = RunningGateway(folder, fans=fans)

    def named(self) -> str:
        client, found = Client(self.running), []
        for path in ("alarms?all=1", f"fans/{TRAY}/2", "alarms/history"):
            found.append(client.ask("GET", f"/api/v1/{path}")[1])
        site = client.ask("GET", "/api/v1/site")[1]["trays"][0]
        alarm, fan, transition = found[0]["alarms"][0], found[1], found[2]["transitions"][0]
        assert (site["names"][2], site["places"][2]) == (fan["name"], fan["place"]) == (alarm["name"], alarm["place"])
        assert alarm["about"] == "90 rpm below the twin"
        spark = client.ask("GET", "/api/v1/sparks")[1]["fans"][2]
        (mark,) = client.ask("GET", f"/api/v1/fans/{TRAY}/2/series?from=0")[1]["marks"]
        assert (spark["name"], mark["name"]) == (fan["name"], fan["name"])
        return "\n".join([alarm["message"], fan["name"], fan["place"], transition["name"], transition["message"]])

    def alarms(self) -> Alarms:
        """Alarms of the fans that the list of alarms and the list of fans agree on."""
        client = Client(self.running)
        found = client.ask("GET", "/api/v1/alarms?all=1")[1]["alarms"]
        groups = [client.ask("GET", f"/api/v1/fans?state={group}")[1]["fans"] for group in ("alarm", "silenced")]
        fans = {each["fan"] for group in groups for each in group}
        return {a["fan"]: (a["acknowledged"], _is_silenced(a)) for a in found if a["active"] and a["fan"] in fans}


def _is_silenced(alarm: Mapping[str, Any]) -> bool:
    return bool(alarm["shelved_until_t_ns"] or alarm["out_of_service"])


class PrometheusOutput(GatewayOutput):
    """The metrics of the gateway."""

    keeps_state = False

    def named(self) -> str:
        """Labels have no text of an alarm."""
        families = text_string_to_metric_families(Client(self.running).ask("GET", "/metrics")[1])
        of_fan = [s.labels for each in families for s in each.samples if s.labels.get("fan") == "2"]
        assert len(of_fan) > 4 and all(labels["name"] == 'CPU "left"' for labels in of_fan)
        return f"{of_fan[0]['name']} (fan 2) " + "".join({labels.get("place", "") for labels in of_fan})

    def alarms(self) -> Alarms:
        families = text_string_to_metric_families(Client(self.running).ask("GET", "/metrics")[1])
        samples = [sample for family in families for sample in family.samples if sample.value]
        fans = {
            name: {int(each.labels["fan"]) for each in samples if each.name == f"fantwin_fan_alarm_{name}"}
            for name in ("active", "unacknowledged")
        }
        return {fan: (fan not in fans["unacknowledged"], False) for fan in fans["active"]}


class OpcuaOutput(Output):
    """The OPC UA server, read by a client of the same library."""

    def __init__(self, folder: Path, fans: Fans = FANS) -> None:
        self.running = RunningOpcua(folder, fans=fans)

    def named(self) -> str:
        return asyncio.run(self._read_names())

    async def _read_names(self) -> str:
        async with OpcuaClient(self.running.url, timeout=60) as client:
            fan = client.get_node(f"ns=2;s={TRAY}/2")
            shown = [await fan.read_display_name(), await fan.read_description()]
            alarm = [client.get_node(f"ns=2;s={TRAY}/2/Alarm/{name}") for name in ("SourceName", "Message")]
            source, message = await client.read_values(alarm)
            below = await client.get_node(f"ns=2;s={TRAY}").get_children_descriptions()
            listed = [each.DisplayName.Text for each in below]
        assert shown[0].Text in listed and source == f"{shown[0].Text} ({TRAY}/2)"
        return "\n".join([*(each.Text or "" for each in shown), message.Text])

    def alarms(self) -> Alarms:
        return asyncio.run(self._read())

    async def _read(self) -> Alarms:
        names = ("ActiveState/Id", "AckedState/Id", "SuppressedOrShelved")
        async with OpcuaClient(self.running.url, timeout=60) as client:
            nodes = [client.get_node(f"ns=2;s={TRAY}/{fan}/Alarm/{name}") for fan in range(FANS) for name in names]
            values = await client.read_values(nodes)
        fans = {fan: values[3 * fan : 3 * fan + 3] for fan in range(FANS)}
        return {fan: (acked, silenced) for fan, (active, acked, silenced) in fans.items() if active}


class MqttOutput(Output):
    """What a real broker keeps."""

    def __init__(self, folder: Path, fans: Fans = FANS) -> None:
        self.broker = Mosquitto(folder)
        self.broker.start()
        self.running = RunningMqtt(folder, self.broker.port, fans=fans, home_assistant=[TRAY])

    def named(self) -> str:
        kept = retained_by(self.broker.port)
        state, alarm = (json.loads(kept[f"{ROOT}/{TRAY}/2/{topic}"]) for topic in ("state", "alarm"))
        (device,) = (json.loads(text)["device"] for topic, text in kept.items() if topic.endswith(f"{TRAY}-2/config"))
        assert (state["name"], state["place"]) == (device["name"], device["suggested_area"])
        return "\n".join([state["name"], state["place"], alarm["name"], alarm["message"]])

    def alarms(self) -> Alarms:
        kept = retained_by(self.broker.port)
        texts = {fan: json.loads(kept.get(f"{ROOT}/{TRAY}/{fan}/alarm") or "null") for fan in range(FANS)}
        return {fan: (a["acknowledged"], _is_silenced(a)) for fan, a in texts.items() if a and a["active"]}

    def close(self) -> None:
        self.running.close()
        self.broker.stop()


class NotifierOutput(Output):
    """A webhook that is sent messages; its clock goes on by a minute with each look."""

    keeps_state = False

    posted: ClassVar[dict[Path, list[Any]]] = {}
    """what the reader has, by folder: more than one notifier may have sent it"""

    def __init__(self, folder: Path, _fans: Fans = FANS) -> None:
        self._receiver = HttpReceiver()
        self._receiver.received = self.posted.setdefault(folder, [])
        url = secret(folder, "hook", f"json://127.0.0.1:{self._receiver.port}/")
        target = {"name": "hook", "url_file": url, "repeat_s": 0}
        config = NotifierConfig.model_validate({"target": [target]})
        self.running = notifier_core(folder, config, {TRAY: FANS})
        self._now_ns = START_NS
        self._is_closed = False

    def feed(self, *messages: Message) -> None:
        for message in messages:
            self.running.step(message)

    def named(self) -> str:
        self.alarms()
        posted = self._receiver.received[-1]
        return f"{posted['title']}\n{posted['message']}\n{PLACE}"  # only messages name the fan here, none its place

    def alarms(self) -> Alarms:
        for _ in range(20):
            self._now_ns += NS_PER_S
            self.running.tick(self._now_ns)
        active: Alarms = {}
        for title in [posted["title"] for posted in self._receiver.received]:
            fan = int(re.findall(r"fan (\d+)\)? of", title)[0])
            active.pop(fan, None) if title.startswith("Cleared") else active.update({fan: (False, False)})
        return active

    def close(self) -> None:
        if not self._is_closed:
            self._is_closed = True
            self.running.close()
            self._receiver.stop()


class ViewerOutput(Output):
    """The table of alarms in the viewer."""

    def __init__(self, _folder: Path, fans: Fans = FANS) -> None:
        self._sink = FakeSink()
        self.running = ViewerCore(SITE, [tray_of(fans)], self._sink)
        self._ticks = 0

    def named(self) -> str:
        assert not self.alarms()
        return f"{self._sink.tables[-1][1]}\n{[line.text for line in self._sink.lines]}\n{PLACE}"

    def feed(self, *messages: Message) -> None:
        for each in messages:
            is_score = isinstance(each, Score)
            self.running.step(Envelope.of(tray_key(SITE, TRAY, "score"), each, 0) if is_score else each)

    def alarms(self) -> Alarms:
        self._ticks += 1
        self.running.tick(self._ticks * FLUSH_PERIOD_NS)
        text = self._sink.tables[-1][1] if self._sink.tables else ""
        rows = re.findall(rf"^\| \*\*{TRAY}/(\d+)\*\* \| (.*?) \|.*\| (.*?) \|$", text, re.MULTILINE)
        return {int(fan): (seen_by != "nobody", "silenced" in words) for fan, words, seen_by in rows}

    def close(self) -> None:
        if not self._sink.closed:
            self.running.close()


PLACE = "rack 3, slot 4"
NAMED: Fans = [{}, {"name": "rear"}, {"name": 'CPU "left"', "place": PLACE}, {}]
OUTPUTS: dict[str, Callable[..., Output]] = {
    "gateway": GatewayOutput,
    "prometheus": PrometheusOutput,
    "opcua": OpcuaOutput,
    "mqtt": MqttOutput,
    "notifier": NotifierOutput,
    "viewer": ViewerOutput,
}


pytestmark = pytest.mark.usefixtures("quickly_hashed")
SEEN = {"acknowledged": True, "operator_name": "ann"}
SHELVED = {"shelved_until_t_ns": NOW_NS + 10**13}
_numbers = itertools.count(100)


def of(fan: int, transition: Transition = Transition.RAISED, **more: object) -> Alarm:
    """The next transition."""
    return replace(alarm(transition, next(_numbers), **more), fan=fan)


def shows(output: Output, fan: int, expected: tuple[bool, bool] | None) -> None:
    """Wait until it shows that a fan is in alarm, and whether that is acknowledged and silenced; None: no alarm."""

    def is_shown() -> bool:
        found = output.alarms().get(fan)
        return found == expected if output.keeps_state else (found is None) == (expected is None)

    eventually(is_shown, f"fan {fan} is shown as {expected}")


@pytest.fixture(scope="module", params=OUTPUTS)
def kind(request: pytest.FixtureRequest) -> Iterator[str]:
    if request.param == "mqtt" and shutil.which("mosquitto") is None:
        pytest.skip("mosquitto is not installed")
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("fantwin.pipeline.site.site_model.SILENT_AFTER_S", 1e9)
        yield request.param


def test_an_alarm_of_before_it_started_is_shown_again_after_a_restart_and_its_end_leaves_nothing_behind(
    kind: str, tmp_path: Path
) -> None:
    """First, so that no thread of an output that other tests share is counted."""
    threads = set(threading.enumerate())
    raised = of(2)
    for again in ((), (of(2, Transition.REPUBLISHED), of(1))):
        running = OUTPUTS[kind](tmp_path)
        try:
            running.feed(raised, *again)
            shows(running, 2, (False, False))
            shows(running, 1, (False, False) if again else None)
        finally:
            running.close()
            running.close()
    eventually(lambda: not [each for each in set(threading.enumerate()) - threads if each.is_alive()], "all has ended")


def test_the_name_of_a_fan_comes_first_everywhere_and_its_place_is_beside_it(kind: str, tmp_path: Path) -> None:
    running = OUTPUTS[kind](tmp_path, NAMED)
    try:
        running.feed(score(), of(2, fan_name='CPU "left"', message='CPU "left" (fan 2): 90 rpm below the twin'))

        def is_named() -> bool:
            with suppress(KeyError, IndexError, ValueError):  # not there yet
                text = running.named()
                assert PLACE in text and 'CPU "left" (fan 2)' in text, text
                assert not re.search(r"(?<!\()fan 2", text), text
                return True
            return False

        eventually(is_named, "the fan is named")
    finally:
        running.close()


@pytest.fixture(scope="module")
def output(kind: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Output]:
    """One for all claims: each has its own fan."""
    running = OUTPUTS[kind](tmp_path_factory.mktemp(kind))
    yield running
    running.close()


def test_an_alarm_is_shown_acknowledged_silenced_and_gone_whoever_asked(output: Output) -> None:
    output.feed(score(), of(0))
    shows(output, 0, (False, False))
    output.feed(of(0, Transition.ACKNOWLEDGED, **SEEN))
    shows(output, 0, (True, False))
    output.feed(of(0, Transition.SHELVED, **SHELVED, **SEEN))
    shows(output, 0, (True, True))
    output.feed(of(0, Transition.UNSHELVED, **SEEN))
    shows(output, 0, (True, False))
    output.feed(of(0, Transition.CLEARED, active=False, **SEEN), score(9.0))
    shows(output, 0, None)


def test_a_late_message_ends_no_alarm(output: Output) -> None:
    late = of(2, Transition.CLEARED, active=False)
    output.feed(score(10.0, state=FanState.ALARM), of(2), late)
    output.feed(score(11.0, state=FanState.STOPPED))
    shows(output, 2, (False, False))


def test_what_it_does_not_know_is_counted_or_shown_and_ends_nothing(output: Output) -> None:
    before = output.refused()
    output.feed(
        of(3, Transition(88), active=False, severity=Severity.NONE),
        of(3, severity=Severity(77)),
        of(99),
        replace(of(1), header=Header("scorer-all-1", next(_numbers), "elsewhere")),
        score(20.0, state=FanState(99)),
        replace(one_sample(9), header=Header("scorer-all-1", next(_numbers), TRAY)),
        of(1),
    )
    shows(output, 1, (False, False))
    assert output.refused() - before >= 1
