"""Every output of a site behind one interface: what is fed to it, and what its reader sees of alarms."""

from __future__ import annotations

import asyncio
import json
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar, Protocol

from asyncua.client.client import Client as OpcuaClient
from prometheus_client.parser import text_string_to_metric_families

from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.outputs.notify.config import NotifierConfig
from fantwin.pipeline.outputs.rerun.viewer_core import FLUSH_PERIOD_NS, ViewerCore
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.messages import Message, Score
from fantwin.schemas.topics import tray_key
from fantwin.schemas.units import NS_PER_S
from tests.support.drawn_views import FakeSink
from tests.support.message_receivers import HttpReceiver
from tests.support.mosquitto import Mosquitto, retained_by
from tests.support.notified_alarms import START_NS, notifier_core, secret
from tests.support.running_core import FANS, SITE, TRAY
from tests.support.running_gateway import Client, RunningGateway
from tests.support.running_mqtt import ROOT, RunningMqtt
from tests.support.running_opcua import RunningOpcua


class Output(Protocol):
    """A running output of a site of one tray of `FANS` fans."""

    keeps_state = True
    """whether its reader sees acknowledgements and silenced fans; otherwise it hears events only"""

    def feed(self, *messages: Message) -> None:
        """Pass messages, as the runner does."""
        ...

    def alarms(self) -> dict[int, tuple[bool, bool]]:
        """Fans with an active alarm: whether it is acknowledged, and whether it is silenced."""
        ...

    def refused(self) -> int:
        """How many messages it has counted as not usable."""
        ...

    def close(self) -> None:
        """End it."""
        ...


def _refused(counters: Mapping[str, int]) -> int:
    names = ("unknown_tray", "unknown_fan", "refused_scores", "wrong_fan_count", "undecodable")
    return sum(counters.get(name, 0) for name in names)


class GatewayOutput:
    """The operators' page, by its API."""

    keeps_state = True

    def __init__(self, folder: Path) -> None:
        self.running = RunningGateway(folder)
        self.feed, self.close = self.running.feed, self.running.close

    def alarms(self) -> dict[int, tuple[bool, bool]]:
        """Alarms of the fans that the list of alarms and the list of fans agree on."""
        client = Client(self.running)
        found = client.ask("GET", "/api/v1/alarms?all=1")[1]["alarms"]
        groups = [client.ask("GET", f"/api/v1/fans?state={group}")[1]["fans"] for group in ("alarm", "silenced")]
        fans = {each["fan"] for group in groups for each in group}
        return {a["fan"]: (a["acknowledged"], _is_silenced(a)) for a in found if a["active"] and a["fan"] in fans}

    def refused(self) -> int:
        return _refused(self.running.counters())


def _is_silenced(alarm: Mapping[str, Any]) -> bool:
    return bool(alarm["shelved_until_t_ns"] or alarm["out_of_service"])


class PrometheusOutput(GatewayOutput):
    """The metrics of the gateway."""

    keeps_state = False

    def alarms(self) -> dict[int, tuple[bool, bool]]:
        families = text_string_to_metric_families(Client(self.running).ask("GET", "/metrics")[1])
        samples = [sample for family in families for sample in family.samples if sample.value]
        fans = {
            name: {int(each.labels["fan"]) for each in samples if each.name == f"fantwin_fan_alarm_{name}"}
            for name in ("active", "unacknowledged")
        }
        return {fan: (fan not in fans["unacknowledged"], False) for fan in fans["active"]}


class OpcuaOutput:
    """The OPC UA server, read by a client of the same library."""

    keeps_state = True

    def __init__(self, folder: Path) -> None:
        self.running = RunningOpcua(folder)
        self.feed, self.close = self.running.feed, self.running.close

    def alarms(self) -> dict[int, tuple[bool, bool]]:
        return asyncio.run(self._read())

    async def _read(self) -> dict[int, tuple[bool, bool]]:
        names = ("ActiveState/Id", "AckedState/Id", "SuppressedOrShelved")
        async with OpcuaClient(self.running.url, timeout=60) as client:
            nodes = [client.get_node(f"ns=2;s={TRAY}/{fan}/Alarm/{name}") for fan in range(FANS) for name in names]
            values = await client.read_values(nodes)
        fans = {fan: values[3 * fan : 3 * fan + 3] for fan in range(FANS)}
        return {fan: (acked, silenced) for fan, (active, acked, silenced) in fans.items() if active}

    def refused(self) -> int:
        return _refused(self.running.counters())


class MqttOutput:
    """What a real broker keeps."""

    keeps_state = True

    def __init__(self, folder: Path) -> None:
        self.broker = Mosquitto(folder)
        self.broker.start()
        self.running = RunningMqtt(folder, self.broker.port)
        self.feed = self.running.feed

    def alarms(self) -> dict[int, tuple[bool, bool]]:
        kept = retained_by(self.broker.port)
        texts = {fan: json.loads(kept.get(f"{ROOT}/{TRAY}/{fan}/alarm") or "null") for fan in range(FANS)}
        return {fan: (a["acknowledged"], _is_silenced(a)) for fan, a in texts.items() if a and a["active"]}

    def refused(self) -> int:
        return _refused(self.running.counters())

    def close(self) -> None:
        self.running.close()
        self.broker.stop()


class NotifierOutput:
    """A webhook that is sent messages; its clock goes on by a minute with each look."""

    keeps_state = False

    posted: ClassVar[dict[Path, list[Any]]] = {}
    """what the reader has, by folder: more than one notifier may have sent it"""

    def __init__(self, folder: Path) -> None:
        self._receiver = HttpReceiver()
        self._receiver.received = self.posted.setdefault(folder, [])
        url = secret(folder, "hook", f"json://127.0.0.1:{self._receiver.port}/")
        target = {"name": "hook", "url_file": url, "repeat_s": 0}
        config = NotifierConfig.model_validate({"target": [target]})
        self.core = notifier_core(folder, config, {TRAY: FANS})
        self._now_ns = START_NS
        self._is_closed = False

    def feed(self, *messages: Message) -> None:
        for message in messages:
            self.core.step(message)

    def alarms(self) -> dict[int, tuple[bool, bool]]:
        for _ in range(20):
            self._now_ns += NS_PER_S
            self.core.tick(self._now_ns)
        active: dict[int, tuple[bool, bool]] = {}
        for title in [posted["title"] for posted in self._receiver.received]:
            fan = int(re.findall(r"fan (\d+) of", title)[0])
            active.pop(fan, None) if title.startswith("Cleared") else active.update({fan: (False, False)})
        return active

    def refused(self) -> int:
        return _refused(self.core.counters())

    def close(self) -> None:
        if not self._is_closed:
            self._is_closed = True
            self.core.close()
            self._receiver.stop()


class ViewerOutput:
    """The table of alarms in the viewer."""

    keeps_state = True

    def __init__(self, _folder: Path) -> None:
        self._sink = FakeSink()
        self._core = ViewerCore(SITE, [TrayConfig(name=TRAY, fans=FANS, speed_unit="rpm")], self._sink)
        self._ticks = 0

    def feed(self, *messages: Message) -> None:
        for each in messages:
            is_score = isinstance(each, Score)
            self._core.step(Envelope.of(tray_key(SITE, TRAY, "score"), each, 0) if is_score else each)

    def alarms(self) -> dict[int, tuple[bool, bool]]:
        self._ticks += 1
        self._core.tick(self._ticks * FLUSH_PERIOD_NS)
        text = self._sink.tables[-1][1] if self._sink.tables else ""
        rows = re.findall(rf"^\| \*\*{TRAY}/(\d+)\*\* \| (.*?) \|.*\| (.*?) \|$", text, re.MULTILINE)
        return {int(fan): (seen_by != "nobody", "silenced" in words) for fan, words, seen_by in rows}

    def refused(self) -> int:
        return _refused(self._core.counters())

    def close(self) -> None:
        if not self._sink.closed:
            self._core.close()


OUTPUTS: dict[str, Callable[[Path], Output]] = {
    "gateway": GatewayOutput,
    "prometheus": PrometheusOutput,
    "opcua": OpcuaOutput,
    "mqtt": MqttOutput,
    "notifier": NotifierOutput,
    "viewer": ViewerOutput,
}
