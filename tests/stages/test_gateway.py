"""The gateway by HTTP: what it shows, and who may do what."""

from __future__ import annotations

import http.client
import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from jsonschema import Draft202012Validator
from prometheus_client.parser import text_string_to_metric_families

from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.outputs.web import answers as typed
from fantwin.pipeline.outputs.web.app import LARGEST_BODY_BYTES
from fantwin.pipeline.recordings.clips.clip import Clip, ClipAlarm, clips_as_text
from fantwin.pipeline.recordings.writing import RecordingWriter
from fantwin.pipeline.site.fans_json import MOST_LIVE, fans_json
from fantwin.pipeline.site.fleet import Fan
from fantwin.pipeline.site.site_json import (
    alarms_json,
    fan_in_full,
    fleet_json,
    rates_json,
    site_json,
    sparks_json,
)
from fantwin.pipeline.site.site_model import SiteModel
from fantwin.schemas.enums import Action, FanState, Severity, Transition
from fantwin.schemas.header import Header
from fantwin.schemas.health import FanLearning, Learning, Sweep
from fantwin.schemas.messages import Diagnosis, Raw, ScorerSnapshot
from fantwin.schemas.topics import tray_key
from fantwin.scoring.wear.recorded_wear import shown
from tests.support.made_messages import filled, health
from tests.support.running_chain import eventually
from tests.support.running_core import FANS, SITE, TRAY
from tests.support.running_gateway import Client, RunningGateway
from tests.support.site_messages import NOW_NS, SCRIPT, STEP_NS, alarm, golden_twin, granted, score
from tests.support.site_users import PASSWORD, make_users

pytestmark = pytest.mark.usefixtures("quickly_hashed", "never_silent")
CONFIGURATION = f'site = "{SITE}"\nrun_folder = "."\n[[tray]]\nname = "{TRAY}"\nfans = {FANS}\nport = "p"\n[gateway]\n'


@pytest.fixture
def users(tmp_path: Path) -> Path:
    return make_users(tmp_path / "users.toml")


@pytest.fixture
def gateway(opened: Callable[..., RunningGateway], tmp_path: Path, users: Path) -> RunningGateway:
    return opened(tmp_path, granted, users=users)


def test_what_the_api_says_of_fans_alarms_and_series_is_what_the_messages_said(gateway, monkeypatch):
    gateway.feed(score(), score(1.0, state=FanState.ALARM), alarm())
    client = Client(gateway)
    fans = client.ask("GET", "/api/v1/fans")[1]["fans"]
    assert [(each["fan"], each["state"]) for each in fans] == [
        (2, "alarm"),
        (0, "normal"),
        (1, "normal"),
        (3, "unknown: samples are missing"),
    ]
    assert fans[1]["score"] == 0.5
    worst, well, _, unjudged = fans
    assert (worst["speed"], worst["speed_unit"], worst["command"]) == (1000.0, "rpm", 0.5)
    assert (worst["cause"], worst["probability"]) == ("drag", 0.8)
    assert (worst["deviation_percent"], worst["deviation"]) == (-0.9901, "90 rpm below the twin (limit 50)")
    assert (well["cause"], well["probability"], well["deviation"]) == ("", None, "")
    assert (unjudged["speed"], unjudged["deviation_percent"]) == (1000.0, None), (
        "it has a speed, and nothing to compare"
    )
    assert client.ask("GET", "/api/v1/fans?state=alarm")[1]["fans"] == fans[:1]
    assert client.ask("GET", "/api/v1/fans?state=not_judged")[1]["fans"] == fans[3:]
    status, body, _ = client.ask("GET", "/api/v1/fans?state=alarms")
    assert (status, "'suspect', 'not_judged', 'silenced', 'at_rest' or 'normal'" in body["error"]) == (422, True)
    assert client.ask("GET", "/api/v1/fans?tray=nowhere")[0] == 404
    (found,) = client.ask("GET", "/api/v1/alarms")[1]["alarms"]
    assert (found["fan"], found["presented"], found["probability"]) == (2, True, 0.8)
    assert found["causes"][0]["evidence"] == "drag +20 %"
    series = client.ask("GET", f"/api/v1/fans/{TRAY}/0/series?points=4000")[1]
    assert series["speed_unit"] == "rpm"
    assert series["t_s"] == [(NOW_NS + 4 * STEP_NS) / 1e9, (NOW_NS + 10**9 + 4 * STEP_NS) / 1e9]
    means = {name: values["mean"] for name, values in series["columns"].items()}
    assert means["measured"] == [1000.0, 1000.0]
    assert means["half_width"] == [20.0, 20.0]
    assert means["command"] == [0.5, 0.5]
    unjudged = client.ask("GET", f"/api/v1/fans/{TRAY}/3/series?points=4000")[1]["columns"]
    assert unjudged["predicted"]["mean"] == [None, None], "where nothing is judged, there is no twin to see"
    assert client.ask("GET", f"/api/v1/fans/{TRAY}/{FANS}")[0] == 404
    assert client.ask("GET", "/api/v1/fans/nowhere/0")[0] == 404
    monkeypatch.setattr("fantwin.pipeline.site.site_model.SILENT_AFTER_S", 0.0)
    silent = f"/api/v1/fans/{TRAY}/0"
    eventually(lambda: client.ask("GET", silent)[1]["state"] == "silent", "the tray is silent")
    metrics = client.ask("GET", "/metrics")[1]
    assert "fantwin_fan_speed_rpm{" not in metrics, "nothing of a fan is shown as now"
    assert 'fantwin_fan_scored{fan="0",site="hall",tray="tray1"} 0' in metrics


def test_every_answer_has_the_type_that_the_description_declares_and_leaves_nothing_out(gateway):
    gateway.feed(score(state=FanState.ALARM), alarm(), golden_twin())
    model = gateway.core._model
    made = {
        "/site": site_json(model, {}),
        "/fans": {"fans": fans_json(model, model.every_fan())},
        f"/fans/{TRAY}/2": fan_in_full(model, Fan(TRAY, 2)),
        "/alarms": alarms_json(model, everything=False),
        "/sparks": sparks_json(model),
        "/alarm-rate": rates_json(model),
    }
    for path, expected in made.items():
        assert Client(gateway).ask("GET", f"/api/v1{path}")[1] == json.loads(json.dumps(expected)), path
    assert typed.Fans.model_validate(made["/fans"]).model_dump(mode="json") == made["/fans"], "it is not checked there"
    described = Client(gateway).ask("GET", "/api/v1/openapi.json")[1]
    operations = [operation for methods in described["paths"].values() for operation in methods.values()]
    for operation in operations:
        assert operation["description"]
        for response in operation["responses"].values():
            assert response["content"], operation["operationId"]
            assert all(content.get("schema") for content in response["content"].values()), operation["operationId"]
    names = [operation["operationId"] for operation in operations]
    assert (len(set(names)), described["servers"]) == (len(names), [{"url": "/"}])
    assert set(described["components"]["securitySchemes"]) == {"HTTPBearer", "APIKeyCookie"}
    for schema in described["components"]["schemas"].values():
        Draft202012Validator.check_schema(schema)
    form = described["components"]["schemas"]["RequestForm"]
    assert (form["additionalProperties"], "shelve" in form["properties"]["action"]["enum"]) == (False, True)


def test_a_fan_without_a_twin_says_what_is_learned_how_far_and_what_would_help(gateway):
    gateway.feed(score())
    fans = (FanLearning(progress=0.25, missing="1 change (10 needed)"), *[FanLearning(progress=0.5, missing="")] * 3)
    waits = Learning(tray=TRAY, what="5 of 10 minutes\nrecorded", until_t_ns=0, helps="`sweep` moves it", fans=fans)
    gateway.feed(health("learner", learning=(waits,)))
    of_fans = {each["fan"]: each["learning"] for each in Client(gateway).ask("GET", "/api/v1/fans")[1]["fans"]}
    assert of_fans[0] == {
        "progress": 0.25,
        "what": "5 of 10 minutes recorded",
        "missing": "1 change (10 needed)",
        "until_t_ns": 0,
        "helps": "`sweep` moves it",
        "command": "fantwin command --tray tray1 --sweep",
    }
    assert (of_fans[1]["progress"], of_fans[1]["helps"], of_fans[1]["command"]) == (0.5, "", "")
    gateway.feed(health("learner", learning=(replace(waits, fans=fans[:1]),)))
    assert Client(gateway).ask("GET", f"/api/v1/fans/{TRAY}/0")[1]["learning"] is None, "it is configured otherwise"
    gateway.feed(health("learner"))
    assert Client(gateway).ask("GET", f"/api/v1/fans/{TRAY}/0")[1]["learning"] is None, "it has a twin now"


def test_without_a_twin_requests_are_refused_at_once_and_no_sweep_is_asked_of_a_learner_that_allows_none(gateway):
    client = Client(gateway)
    assert client.log_in("ann", PASSWORD) == 200
    sweep, act = f"/api/v1/trays/{TRAY}/sweep", f"/api/v1/fans/{TRAY}/0/requests"
    assert client.ask("POST", sweep, {})[0] == 409, "no learner is heard"
    fans = (FanLearning(progress=0.5, missing=""),) * FANS
    waits = Learning(tray=TRAY, what="5 of 10 minutes recorded", until_t_ns=0, helps="", fans=fans)
    gateway.feed(health("learner", learning=(waits,)))
    status, said, _ = client.ask("POST", act, {"action": "commission"})
    assert (status, said["error"]) == (
        409,
        "tray tray1 has no twin yet (5 of 10 minutes recorded): nothing judges its fans, and there is no alarm to act "
        "on; ask again when it has one, `fantwin status` says what that waits for",
    )
    for method in ("GET", "POST", "DELETE"):
        status, said, _ = client.ask(method, sweep, {})
        assert (status, said["error"]) == (
            409,
            "no sweep of tray tray1 may be started from here: set `sweep_on_request = true` in [learner], or run "
            "`fantwin command --tray tray1 --sweep`",
        )
    assert gateway.sent == []
    assert client.ask("POST", "/api/v1/trays/other/sweep", {})[0] == 404
    gateway.feed(health("learner", learning=(replace(waits, sweep=Sweep(plan="fan 0")),)))
    assert client.ask("GET", sweep)[1] == {"plan": "fan 0", "running": "", "ended": ""}
    viewer = Client(gateway)
    assert viewer.ask("POST", sweep, {})[0] == 401
    assert viewer.log_in("vic", PASSWORD) == 200
    assert (viewer.ask("POST", sweep, {})[0], viewer.ask("DELETE", sweep, {})[0]) == (403, 403)
    other_site = {"Origin": "http://elsewhere"}
    assert client.ask("POST", sweep, {}, other_site)[0] == 403
    assert gateway.sent == []
    gateway.feed(health("learner"), score())
    granted_now = client.ask("POST", f"/api/v1/fans/{TRAY}/2/requests", {"action": "acknowledge"})
    assert granted_now[0] == 200, "it has a twin now"


def test_live_events_bring_an_alarm_and_the_samples_of_the_fan_that_is_looked_at(gateway):
    gateway.feed(score())
    connection = http.client.HTTPConnection("127.0.0.1", gateway.port, timeout=20)
    connection.request("GET", f"/api/v1/events?fan={TRAY}/1")
    stream = connection.getresponse()

    def event(wanted: str) -> dict[str, object]:
        while True:
            line = stream.readline().decode()
            if line == f"event: {wanted}\n":
                return json.loads(stream.readline().decode().removeprefix("data: "))

    fleet = event("fleet")
    assert fleet["counts"] == {"in_alarm": 0, "suspect": 0, "not_judged": 1, "silenced": 0}
    assert fleet["values"] == {
        "fans": [0, 1, 2, 3],
        "speed": [1000.0] * 4,
        "command": [0.5] * 4,
        "deviation_percent": [-0.9901, -0.9901, -0.9901, None],
        "twin": [1010.0, 1010.0, 1010.0, None],
        "half_width": [20.0, 20.0, 20.0, None],
    }
    large = SiteModel(SITE, (TrayConfig(name=TRAY, fans=MOST_LIVE + 1),))
    assert fleet_json(large)["values"]["fans"] == [], "of a large site only fans in alarm have their speeds sent"
    large.add_alarm(alarm())
    assert fleet_json(large)["values"]["fans"] == [2]
    gateway.feed(score(1.0))
    assert event("samples")["measured"] == [1000.0] * 5
    gateway.feed(alarm())
    assert event("alarm")["fan"] == 2
    connection.close()


def test_metrics_are_those_of_prometheus_and_an_alarm_counts_once_in_each_severity_that_it_reaches(gateway):
    warned, worse, worst = Transition.RAISED, Transition.SEVERITY, Severity.ALARM
    gateway.feed(score(state=FanState.ALARM), alarm(warned, 0))

    def samples() -> dict[tuple[str, str | None, str | None], float]:
        return {
            (s.name, s.labels.get("fan"), s.labels.get("severity")): s.value
            for family in text_string_to_metric_families(Client(gateway).ask("GET", "/metrics")[1])
            for s in family.samples
        }

    found = samples()
    assert found["fantwin_fan_speed_rpm", "0", None] == pytest.approx(1000.0, rel=1e-6)
    assert found["fantwin_fan_score_ratio", "0", None] == 0.5
    assert found["fantwin_fan_command", "0", None] == 0.5
    assert found["fantwin_fan_deviation_rpm", "0", None] == pytest.approx(-10.0, abs=0.01)
    assert found["fantwin_build_info", None, None] == 1.0
    assert ("fantwin_fan_deviation_rpm", "3", None) not in found
    assert ("fantwin_fan_score_ratio", "3", None) not in found, "an unjudged fan has none"
    assert found["fantwin_fan_scored", "3", None] == 0.0
    assert found["fantwin_alarms_total", None, "alarm"] == 1.0
    assert found["fantwin_alarms_total", None, "warning"] == 0.0, "counted from zero, so that the first one is seen"
    for number, severity in enumerate((Severity.WARNING, worst, Severity.WARNING, worst), 1):
        transition = worse if number > 1 else warned
        gateway.feed(alarm(transition, number, severity=severity, onset_t_ns=NOW_NS + 1))
    found = samples()
    assert [found["fantwin_alarms_total", None, each] for each in ("warning", "alarm")] == [1.0, 2.0]


def test_an_operator_acts_under_his_own_name_and_nobody_else_acts(gateway):
    gateway.feed(score(), alarm())
    path, asked = f"/api/v1/fans/{TRAY}/2/requests", {"action": "acknowledge", "comment": SCRIPT}
    stranger, viewer, operator = Client(gateway), Client(gateway), Client(gateway)
    assert stranger.ask("POST", path, asked)[0] == 401
    assert stranger.log_in("ann", "wrong wrong wrong") == 401
    assert viewer.log_in("vic", PASSWORD) == 200
    assert viewer.ask("POST", path, asked)[0] == 403
    assert operator.log_in("ann", PASSWORD) == 200
    for form, why in (
        (asked | {"operator_name": "root"}, "operator_name"),
        ({"action": "false_alarm", "comment": " "}, "a false alarm needs a reason"),
        ({"action": "shelve", "onset_t_ns": NOW_NS}, "onset_t_ns is for true_alarm and false_alarm only"),
    ):
        status, body, _ = operator.ask("POST", path, form)
        assert (status, why in body["error"]) == (422, True), body
    assert gateway.sent == []
    status, body, _ = operator.ask("POST", path, asked)
    assert (status, body["answers"][0]["transition"]) == (200, "acknowledged")
    (sent,) = gateway.sent
    assert (sent.action, sent.fan, sent.operator_name, sent.comment) == (Action.ACKNOWLEDGE, 2, "ann", SCRIPT)
    (found,) = operator.ask("GET", "/api/v1/alarms")[1]["alarms"]
    assert found["acknowledged_by"] == "ann"
    marked_false = {"action": "false_alarm", "comment": "the door was open", "onset_t_ns": NOW_NS}
    assert operator.ask("POST", path, marked_false)[0] == 200
    last = gateway.sent[-1]
    assert (last.action, last.onset_t_ns, last.comment) == (Action.FALSE_ALARM, NOW_NS, "the door was open")


def test_a_fan_is_found_by_its_name_as_by_its_number(opened, tmp_path):
    named = [{"name": "CPU"}, {}, {"name": "rear top"}, {}]
    gateway = opened(tmp_path, granted, named, users=make_users(tmp_path / "users.toml"))
    gateway.feed(score(), alarm())
    operator = Client(gateway)
    assert operator.log_in("ann", PASSWORD) == 200
    by_name = f"/api/v1/fans/{TRAY}/rear%20top"
    assert operator.ask("GET", by_name)[1]["fan"] == operator.ask("GET", f"/api/v1/fans/{TRAY}/2")[1]["fan"] == 2
    csv = operator.ask("GET", f"{by_name}/series?format=csv")[2]["content-disposition"]
    assert csv == f'attachment; filename="{TRAY}-fan2.csv"'
    assert operator.ask("POST", f"{by_name}/requests", {"action": "acknowledge"})[0] == 200
    assert [each.fan for each in gateway.sent] == [2]
    for wrong, why in (("4", "has fans 0 to 3"), ("front", "there are CPU (fan 0), rear top (fan 2)")):
        status, body, _ = operator.ask("GET", f"/api/v1/fans/{TRAY}/{wrong}")
        assert (status, why in body["error"]) == (404, True), body


def test_forged_sessions_and_posts_from_other_sites_get_nowhere(gateway):
    path, asked = f"/api/v1/fans/{TRAY}/2/requests", {"action": "acknowledge"}
    operator = Client(gateway)
    assert operator.log_in("ann", PASSWORD) == 200
    forged = Client(gateway)
    forged.cookie, forged.token = operator.cookie[:-4] + "AAAA", operator.token
    assert forged.ask("POST", path, asked)[0] == 401
    for headers in (
        {"X-CSRF-Token": "another"},
        {"Origin": "http://evil.example"},
        {"Sec-Fetch-Site": "cross-site"},
        {"Sec-Fetch-Site": "same-site"},
    ):
        assert operator.ask("POST", path, asked, headers)[0] == 403, headers
    assert operator.ask("POST", path, asked, {"Content-Type": "text/plain"})[0] == 422
    assert operator.ask("POST", path, asked | {"comment": " " * LARGEST_BODY_BYTES})[0] == 413
    assert operator.ask("GET", "/api/v1/site", None, {"Host": "evil.example"})[0] == 400, "a name bound to loopback"
    assert gateway.sent == []
    assert operator.ask("POST", "/api/v1/logout", {})[0] == 200
    assert operator.ask("POST", path, asked)[0] == 401, "the session is over on the server, too"


def test_a_proxy_names_the_user_and_others_cannot(opened, tmp_path):
    gateway = opened(tmp_path, granted, user_header="X-User", operators=("ann",))
    client, path, asked = Client(gateway), f"/api/v1/fans/{TRAY}/2/requests", {"action": "acknowledge"}
    assert client.ask("GET", "/api/v1/site")[0] == 401
    assert client.ask("GET", "/api/v1/site", None, {"X-User": "vic"})[1]["site"] == SITE
    twice = http.client.HTTPConnection("127.0.0.1", gateway.port, timeout=20)
    twice.putrequest("GET", "/api/v1/site")
    for name in ("ann", "vic"):
        twice.putheader("X-User", name)
    twice.endheaders()
    assert twice.getresponse().status == 401, "a header that comes twice names nobody"
    twice.close()
    status, answer, _ = client.ask("POST", path, asked)
    assert (status, answer["error"][:31]) == (401, "the proxy has sent no X-User wi")
    assert client.ask("POST", path, asked, {"X-User": "vic"})[0] == 403
    assert client.ask("POST", path, asked, {"X-User": "ann"})[0] == 200
    assert gateway.sent[0].operator_name == "ann"
    other = opened(tmp_path / "other", user_header="X-User", operators=("ann",), proxies=("192.0.2.1",))
    assert Client(other).ask("GET", "/api/v1/site", None, {"X-User": "ann"})[0] == 401
    status, answer, _ = Client(other).ask("POST", path, asked, {"X-User": "ann"})
    assert (status, answer["error"]) == (401, "users come through the proxy of this page: ask there")


def test_the_history_begins_with_the_first_start_and_survives_a_restart(tmp_path):
    def history(gateway: RunningGateway) -> dict[str, Any]:
        return Client(gateway).ask("GET", "/api/v1/alarms/history")[1]

    gateway = RunningGateway(tmp_path, started_t_ns=NOW_NS)
    try:
        for sequence in range(3):
            gateway.feed(alarm(sequence=sequence, t_ns=NOW_NS + sequence, message=f"{sequence}"))
        assert [each["message"] for each in history(gateway)["transitions"]] == ["2", "1", "0"]
        before = history(gateway)
        number = before["transitions"][0]["number"]
        page = Client(gateway).ask("GET", f"/api/v1/alarms/history?limit=1&before={number}")[1]
        assert page["transitions"] == before["transitions"][1:2]
    finally:
        gateway.close()
    gateway = RunningGateway(tmp_path, started_t_ns=NOW_NS + 60 * 10**9)
    try:
        assert history(gateway) == before
        assert before["begins_t_ns"] == NOW_NS
    finally:
        gateway.close()


def test_a_fan_shows_its_wear_its_advice_and_where_rerun_is(opened, tmp_path):
    gateway = opened(tmp_path, configuration=CONFIGURATION)
    known = {"seen_t_ns": NOW_NS - 5, "change": -0.2, "change_std_error": 0.01, "days": math.nan}
    fans = [{**shown(None), **(known if fan == 2 else {})} for fan in range(FANS)]
    state = json.dumps({"wear": {"fans": fans}})
    snapshot = ScorerSnapshot(header=Header("scorer-all-1", 0, TRAY), t_ns=NOW_NS, twin_sha256="", state_json=state)
    gateway.feed(score(), alarm(causes=(Diagnosis(cause="drag_up", probability=0.8, evidence="drag +20 %"),)), snapshot)
    gateway.feed(replace(snapshot, state_json="{"), replace(snapshot, t_ns=NOW_NS - 1, state_json='{"wear": {}}'))
    client = Client(gateway)
    worn = client.ask("GET", f"/api/v1/fans/{TRAY}/2")[1]
    (row,) = worn["wear"]
    assert (row["parameter"], row["change"], row["error"], row["limit"]) == ("speed", -0.2, 0.01, 0.1)
    assert (row["t_ns"], row["days"]) == (NOW_NS - 5, None)
    metric = 'fantwin_fan_wear_ratio{fan="2",site="hall",tray="tray1"} -0.2'
    assert metric in client.ask("GET", "/metrics")[1].splitlines()
    assert "filter" in worn["alarm"]["advice"]
    assert client.ask("GET", f"/api/v1/fans/{TRAY}/1")[1]["wear"] == []
    (tray,) = client.ask("GET", "/api/v1/site")[1]["trays"]
    assert tray["viewer_url"] == "http://127.0.0.1:9976/?url=rerun%2Bhttp%3A%2F%2F127.0.0.1%3A9876%2Fproxy"


RAISED_NS = 1_800_000_000_000_000_000


def test_clips_of_alarms_are_listed_and_downloaded_and_nothing_else_of_the_disk_is(opened, tmp_path):
    folder = tmp_path / "runs" / "clips"
    folder.mkdir(parents=True)
    content = "a recording " * 1000
    alarms = (ClipAlarm(3, RAISED_NS, RAISED_NS, "rear", acknowledged=True),)
    size, window = len(content), (RAISED_NS, RAISED_NS + 9, RAISED_NS)
    kept = Clip("tray1-3-x.mcap", TRAY, *window, alarms, is_due=False, size_bytes=size)
    others = [replace(kept, name="../secret.json"), replace(kept, name="gone.mcap"), replace(kept, tray="tray9")]
    (folder / "recording.json").write_bytes(clips_as_text([kept, *others]))
    (folder / kept.name).write_text(content)
    (tmp_path / "runs" / "secret.json").write_text("secret")
    text = f'[[tray]]\nname = "{TRAY}"\nfans = 4\n[recorder]\n[gateway]\n'
    running = opened(tmp_path, configuration=text, user_header="X-User")
    client, viewer = Client(running), {"X-User": "vic"}
    assert client.ask("GET", "/api/v1/clips")[0] == 401
    assert client.ask("GET", f"/api/v1/clips/{kept.name}")[0] == 401
    (listed, *more) = client.ask("GET", "/api/v1/clips", headers=viewer)[1]["clips"]
    assert (listed["name"], listed["bytes"], listed["acknowledged"]) == (kept.name, size, True)
    assert listed["alarms"] == [{"fan": 3, "name": "rear", "onset_t_ns": RAISED_NS, "t_ns": RAISED_NS}]
    assert more == []
    status, body, headers = client.ask("GET", f"/api/v1/clips/{kept.name}", headers=viewer)
    assert (status, body) == (200, content)
    assert headers["content-type"] == "application/octet-stream"
    assert headers["content-disposition"] == f'attachment; filename="{kept.name}"'
    assert headers["content-length"] == str(size)
    for name in ("gone.mcap", "recording.json", "..%2Fsecret.json", "../secret.json", "%2Fetc%2Fpasswd", "x%00"):
        assert client.ask("GET", f"/api/v1/clips/{name}", headers=viewer)[0] == 404


def test_a_fan_is_shown_over_any_range_from_the_recordings_of_this_host(opened, tmp_path):
    (tmp_path / "runs").mkdir()
    t_ns = NOW_NS + np.arange(3600) * 10**9
    sent = filled(Raw, 3600, 4, host_receive_t_ns=t_ns, speed_rad_s=100.0, command=50.0, header=Header("a", 0, TRAY))
    with RecordingWriter(tmp_path / "runs" / "recording.mcap", {"site": SITE, "trays": TRAY}) as writer:
        writer.add_message(tray_key(SITE, TRAY, "raw"), sent, int(t_ns[-1]))
    text = f'[[tray]]\nname = "{TRAY}"\nfans = 4\n[recorder]\n[gateway]\n'
    client = Client(opened(tmp_path, configuration=text))
    begin = NOW_NS / 1e9
    path = f"/api/v1/fans/{TRAY}/1/series?from={begin}&to={begin + 3600}&points="
    status, body, _ = client.ask("GET", f"{path}60")
    assert (status, len(body["t_s"]), body["bucket_s"], body["speed_unit"]) == (200, 60, 60.0, "rpm")
    assert typed.Series.model_validate(body).model_dump() == body
    assert set(body["columns"]["measured"]["max"]) == {954.93}
    status, table, headers = client.ask("GET", f"{path}2&format=csv")
    assert (status, headers["content-type"]) == (200, "text/csv; charset=utf-8")
    assert headers["content-disposition"] == f'attachment; filename="{TRAY}-fan1.csv"'
    assert table.startswith("time,deviation_rpm_min,deviation_rpm_mean")
    assert len(table.splitlines()) == 3
    assert client.ask("GET", f"{path}4001")[0] == 422
    assert client.ask("GET", f"/api/v1/fans/{TRAY}/1/series?from=2&to=1")[1] == {"error": "from: is not before to"}
    status, unseen, _ = client.ask("GET", f"/api/v1/fans/{TRAY}/1/series")
    assert (status, unseen["t_s"]) == (200, []), "nothing was ever heard"


def test_a_stage_that_the_configuration_asks_for_and_that_never_came_is_shown_as_missing(opened, tmp_path):
    gateway = opened(tmp_path, configuration=CONFIGURATION)
    found = {each["name"]: each["state"] for each in Client(gateway).ask("GET", "/api/v1/stages")[1]["stages"]}
    assert (found["scorer"], found[f"acquisition/{TRAY}"]) == ("missing", "missing")
    assert 'fantwin_stage_up{site="hall",stage="scorer"} 0.0' in Client(gateway).ask("GET", "/metrics")[1]
