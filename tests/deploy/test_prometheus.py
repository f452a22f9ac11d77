"""Prometheus and Grafana: the rules and queries of `deploy/`, on what a real Prometheus scrapes of a gateway."""

from __future__ import annotations

import json
import math
import re
import shutil
import subprocess
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from fantwin.schemas.enums import FanState, StageStatus
from fantwin.schemas.fields import columns
from fantwin.schemas.health import Health, Input, LatencyBucket, Output
from fantwin.schemas.messages import Score
from tests.support import made_messages
from tests.support.ports import free_port
from tests.support.running_chain import eventually
from tests.support.running_core import FANS, SITE, TRAY
from tests.support.running_gateway import Client, RunningGateway
from tests.support.site_messages import alarm, score


def problems_of(board: Mapping[str, Any]) -> list[str]:
    """Fields that the schema does not have, and values that it reads as others."""
    sdk = pytest.importorskip("grafana_foundation_sdk.models.dashboard", reason="grafana-foundation-sdk of `dev`")
    from grafana_foundation_sdk.cog.encoder import JSONEncoder  # type: ignore[import-not-found]  # noqa: PLC0415
    from grafana_foundation_sdk.cog.plugins import register_default_plugins  # type: ignore[import-not-found]  # noqa: PLC0415

    register_default_plugins()  # the options of each kind of panel, the queries of each kind of source
    read = sdk.Dashboard.from_json(board)
    written = json.loads(json.dumps(read, cls=JSONEncoder))
    return [*_lost(board, written, "board")]


def _lost(had: Any, has: Any, where: str) -> Iterator[str]:
    """What the schema does not know: it is not written again."""
    if isinstance(had, dict) and isinstance(has, dict):
        for name, value in had.items():
            if name in has:
                yield from _lost(value, has[name], f"{where}.{name}")
            else:
                yield f"{where}.{name} is not in the schema"
    elif isinstance(had, list) and isinstance(has, list) and len(had) == len(has):
        for number, (one, other) in enumerate(zip(had, has, strict=True)):
            yield from _lost(one, other, f"{where}[{number}]")
    elif had != has:
        yield f"{where}: {had!r} is read as {has!r}"


DEPLOY = Path(__file__).parents[2] / "deploy"
INTERVAL = "500ms"

needs_prometheus = pytest.mark.skipif(
    shutil.which("prometheus") is None or shutil.which("promtool") is None, reason="prometheus is not installed"
)


class RunningPrometheus:
    """target: port of the gateway that it scrapes."""

    def __init__(self, folder: Path, target: int) -> None:
        configuration = yaml.safe_load((DEPLOY / "prometheus" / "prometheus.yml").read_text())
        configuration["global"] = {"scrape_interval": INTERVAL, "scrape_timeout": INTERVAL, "evaluation_interval": "1s"}
        (scraped,) = configuration["scrape_configs"]
        scraped["static_configs"][0]["targets"] = [f"127.0.0.1:{target}"]
        for name in configuration["rule_files"]:
            shutil.copy(DEPLOY / "prometheus" / name, folder)
        path = folder / "prometheus.yml"
        path.write_text(yaml.safe_dump(configuration))
        self.port = free_port()
        self._process = subprocess.Popen(
            [
                *("prometheus", f"--config.file={path}", f"--storage.tsdb.path={folder / 'data'}"),
                *(f"--web.listen-address=127.0.0.1:{self.port}", "--log.level=warn"),
            ],
            stderr=(folder / "log").open("wb"),
        )
        eventually(self._is_ready, "Prometheus is ready")

    def query(self, expression: str) -> list[tuple[dict[str, str], float]]:
        """Labels and values now; without those that are not a number."""
        found = self.ask("query", query=expression)
        assert found["resultType"] == "vector", expression
        values = [(each["metric"], float(each["value"][1])) for each in found["result"]]
        return [(labels, value) for labels, value in values if not math.isnan(value)]

    def value(self, expression: str) -> float | None:
        """The only value now; None: there is none."""
        found = self.query(expression)
        assert len(found) <= 1, (expression, found)
        return found[0][1] if found else None

    def alert_states(self) -> dict[str, str]:
        """States of alerts by name: inactive, pending or firing. Every rule must have been evaluated without error."""
        rules = [rule for group in self.ask("rules")["groups"] for rule in group["rules"]]
        assert all(not rule.get("lastError") for rule in rules), rules
        return {rule["name"]: rule["state"] for rule in rules if rule["type"] == "alerting" and rule["health"] == "ok"}

    def ask(self, path: str, **parameters: str) -> Any:
        """What its API answers."""
        url = f"http://127.0.0.1:{self.port}/api/v1/{path}?{urllib.parse.urlencode(parameters)}"
        try:
            with urllib.request.urlopen(url, timeout=20) as answer:
                return json.load(answer)["data"]
        except urllib.error.HTTPError as error:
            raise AssertionError(f"{parameters}: {error.read().decode()}") from error

    def close(self) -> None:
        self._process.kill()
        self._process.wait()

    def _is_ready(self) -> bool:
        assert self._process.poll() is None, "Prometheus has ended"
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{self.port}/-/ready", timeout=20) as answer:
                return answer.status == 200
        except OSError:
            return False


RULES = DEPLOY / "prometheus" / "fantwin.rules.yml"
RULE_TESTS = Path(__file__).with_name("fantwin.rules.test.yml")
BOARD = DEPLOY / "grafana" / "fantwin.json"
VARIABLES = {"$site": SITE, "$tray": TRAY, "$fan": "2", "$__rate_interval": "5m"}
ALL_FANS = 2 * FANS
EMPTY_WHILE_HEALTHY = ["Fans in alarm"]
"""a table"""
BAD_NUMBERS = {"Number of fans in alarm": [1], "Fans not judged": [1], "Stages not working": [1]}
NOT_WITHIN_A_TEST = {"FantwinStageMissing"}
"""it looks an hour back; `promtool test rules` has that hour"""


def alerts() -> set[str]:
    groups = yaml.safe_load(RULES.read_text())["groups"]
    return {rule["alert"] for group in groups for rule in group["rules"] if "alert" in rule}


def board_queries() -> list[tuple[str, str]]:
    """Title of the panel (and which of its queries), and query, with the values of the board's variables."""
    panels = json.loads(BOARD.read_text())["panels"]
    found = [
        (panel["title"] if target["refId"] == "A" else f"{panel['title']} {target['refId']}", target["expr"])
        for panel in panels
        for target in panel.get("targets", ())
    ]
    for name, value in VARIABLES.items():
        found = [(title, query.replace(name, value)) for title, query in found]
    assert all("$" not in query for _, query in found)
    return found


def judged(second: float, *unknown: int) -> Score:
    """A score of ALL_FANS, all but these normal."""
    made = score(second)
    wide = {name: np.tile(getattr(made, name), ALL_FANS // made.fans) for name in columns(Score) if name != "t_ns"}
    state = np.full((len(made.t_ns), ALL_FANS), FanState.NORMAL, np.uint8)
    state[:, unknown] = FanState.UNKNOWN
    return replace(made, fans=ALL_FANS, **wide | {"state": state, "valid": state != FanState.UNKNOWN})


def health(stage: str, messages: int, uptime_s: float, latency_s: float = 0.05, **more: Any) -> Health:
    """The health of a stage whose outputs are all of one age."""
    latencies = tuple(
        LatencyBucket(upper_s=upper_s, count=messages * (latency_s <= upper_s))
        for upper_s in (0.1, 1.0, 10.0, math.inf)
    )
    key, t_ns = f"fantwin/{SITE}/{TRAY}/", messages * 10**9
    received = Input(key=f"{key}in", producer="p-1", received=messages, missing=0, duplicated=0, next_sequence=messages)
    values = {
        "inputs": (received,),
        "outputs": (Output(key=f"{key}out", published=messages),),
        "latencies": latencies,
        "latency_sum_s": messages * latency_s,
        **{"t_ns": t_ns, "newest_input_t_ns": t_ns, "uptime_s": uptime_s, **more},
    }
    return made_messages.health(stage, sequence=messages, **values)


@pytest.fixture
def gateway(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[RunningGateway]:
    """What it was last fed with does not grow old, however long Prometheus takes."""
    for module in ("fantwin.pipeline.site.site_model", "fantwin.pipeline.site.stage_states"):
        monkeypatch.setattr(f"{module}.SILENT_AFTER_S", math.inf)
    with closing(RunningGateway(tmp_path, fans=ALL_FANS)) as running:
        yield running


@pytest.fixture
def prometheus(tmp_path: Path, gateway: RunningGateway) -> Iterator[RunningPrometheus]:
    with closing(RunningPrometheus(tmp_path, gateway.port)) as running:
        yield running


def promtool(*words: str | Path, text: str | None = None) -> str:
    done = subprocess.run(["promtool", *words], input=text, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr


@needs_prometheus
def test_every_query_of_the_board_and_every_rule_works_on_what_a_site_sends(gateway, prometheus):
    def feed_and_wait(number: int, uptime_s: float, *fans: int, **more: Any) -> None:
        """Feed scores and healths, and wait until Prometheus has them."""
        gateway.feed(judged(number, *fans))
        gateway.feed(health("scorer", 100 * number, uptime_s, **more), health("recorder", 100 * number, 100.0 * number))
        received = f'fantwin_stage_received_messages_total{{site="{SITE}",stage="scorer"}}'
        eventually(lambda: prometheus.value(received) == 100 * number, "Prometheus has scraped what was fed")

    feed_and_wait(1, 100.0)
    feed_and_wait(2, 200.0)
    eventually(lambda: prometheus.alert_states().keys() == alerts(), "all rules have been evaluated")
    latencies = f'fantwin_stage_latency_seconds_count{{site="{SITE}",stage="scorer"}}'
    eventually(lambda: prometheus.value(latencies) == 200, "the histogram has every output")
    shown: dict[str, list[tuple[dict[str, str], float]]] = {}

    def is_shown() -> bool:
        """Samples of one moment: where a scrape comes late on a busy machine, nothing is there until the next."""
        shown.update({title: prometheus.query(query) for title, query in board_queries()})
        return [title for title, found in shown.items() if not found] == EMPTY_WHILE_HEALTHY

    eventually(is_shown, "every other panel shows something")
    values = {title: [value for _, value in found] for title, found in shown.items()}
    assert values["Fans"] == [ALL_FANS]
    assert values["Fans not judged"] == values["Stages not working"] == values["Lost in the last hour"] == [0.0]
    assert set(values["Score against its limit"]) == {0.5}
    eventually(lambda: set(prometheus.alert_states().values()) == {"inactive"}, "no alert")

    gateway.feed(alarm(), health("viewer", 1, 1.0, status=StageStatus.STOPPED))
    for number in range(3, 7):  # the scorer starts again and again, loses data, and is late
        feed_and_wait(number, 10.0 - number, 1, lost=5, latency_s=5.0, status=StageStatus.DEGRADED)
    eventually(lambda: not is_shown() and all(shown.values()), "every panel shows something")
    assert [labels for labels, _ in shown["Fans in alarm"]] == [{"tray": TRAY, "fan": "2", "severity": "alarm"}]
    assert len(shown["Worst fans"]) == ALL_FANS - 1, "what is not judged has no score"
    assert {title: [value for _, value in shown[title]] for title in BAD_NUMBERS} == BAD_NUMBERS

    def have_gone_off(*but: str) -> bool:
        states = prometheus.alert_states()
        return {name for name, state in states.items() if state != "inactive"} == alerts() - NOT_WITHIN_A_TEST - {*but}

    eventually(lambda: have_gone_off("FantwinManyFansNotScored", "FantwinGatewayAbsent"), "the rules go off")
    feed_and_wait(7, 1.0, 1, 3, 4, lost=5, latency_s=5.0, status=StageStatus.DEGRADED)
    eventually(lambda: have_gone_off("FantwinFansNotScored", "FantwinGatewayAbsent"), "many fans are one alert")
    gateway.close()
    eventually(lambda: prometheus.alert_states()["FantwinGatewayAbsent"] != "inactive", "nothing is scraped any more")


@needs_prometheus
def test_the_rules_say_what_their_own_tests_expect(tmp_path):
    promtool("check", "config", RULES.with_name("prometheus.yml"))
    promtool("test", "rules", RULE_TESTS)
    tested = yaml.safe_load(RULE_TESTS.read_text())["tests"]
    fired = {each["alertname"] for test in tested for each in test["alert_rule_test"] if each["exp_alerts"]}
    assert fired == alerts()


@needs_prometheus
@pytest.mark.parametrize("counts", [(3,), (5, 3)])
def test_prometheus_finds_nothing_to_say_against_the_metrics_whatever_another_program_sends(gateway, counts):
    bounds = (0.1, math.inf) if len(counts) > 1 else (0.1,)
    damaged = tuple(LatencyBucket(upper_s=upper_s, count=count) for upper_s, count in zip(bounds, counts, strict=False))
    gateway.feed(judged(1.0), alarm(), health("scorer", 100, 10.0), health("learner", 100, 10.0, latencies=damaged))
    metrics = Client(gateway).ask("GET", "/metrics")[1]
    assert not promtool("check", "metrics", text=metrics)
    shown = re.findall(
        r'^fantwin_stage_latency_seconds_count\{site="hall",stage="(\w+)"\} (\S+)$', metrics, re.MULTILINE
    )
    assert shown == [("scorer", "100.0")]


def test_the_board_is_one_of_grafanas_schema():
    assert problems_of(json.loads(BOARD.read_text())) == []
