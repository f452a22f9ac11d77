"""The OPC UA server, seen by a client of another make (node-opcua), encrypted and logged in."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from fantwin.schemas.enums import Action, FanState, Transition
from fantwin.schemas.messages import Alarm, Request
from fantwin.scoring.alarms.alarm_state import UNTIL_IT_CLEARS_T_NS
from tests.support.node_opcua import PACKAGE, VERSION, WHAT, NodeOpcua
from tests.support.node_packages import node_modules
from tests.support.running_chain import eventually
from tests.support.running_core import SITE, TRAY
from tests.support.running_opcua import RunningOpcua
from tests.support.site_messages import NOW_NS, alarm, score
from tests.support.site_users import OPERATOR, PASSWORD, VIEWER

pytestmark = pytest.mark.usefixtures("quickly_hashed")
FAN = f"ns=2;s={TRAY}/2"
ALARM = f"{FAN}/Alarm"
SERVER = "ns=0;i=2253"
TIMED_SHELVE, ONE_SHOT_SHELVE, UNSHELVE = "ns=0;i=2949", "ns=0;i=2948", "ns=0;i=2947"
REMOVE_FROM_SERVICE = "ns=0;i=17869"
DISABLE = "ns=0;i=9028"
CONDITION_TYPE, REFRESH = "ns=0;i=2782", "ns=0;i=3875"


class Scorer:
    """Keeps the alarm of fan 2 as a scorer does, and grants or refuses."""

    def __init__(self) -> None:
        self.state: dict[str, Any] = {}
        self.asked: list[Request] = []

    def __call__(self, request: Request) -> list[Alarm]:
        self.asked.append(request)
        is_once = request.action == Action.SHELVE and not request.duration_s
        until = UNTIL_IT_CLEARS_T_NS if is_once else NOW_NS + round(request.duration_s * 1e9)
        transition, changed, is_refused = {
            Action.ACKNOWLEDGE: (
                Transition.ACKNOWLEDGED,
                {"acknowledged": True},
                self.state.get("acknowledged"),
            ),
            Action.SHELVE: (Transition.SHELVED, {"shelved_until_t_ns": until}, False),
            Action.UNSHELVE: (
                Transition.UNSHELVED,
                {"shelved_until_t_ns": 0},
                not self.state.get("shelved_until_t_ns"),
            ),
            Action.OUT_OF_SERVICE: (Transition.OUT_OF_SERVICE, {"out_of_service": True}, False),
            Action.COMMENT: (Transition.COMMENTED, {}, not request.comment),
        }[request.action]
        if is_refused:
            transition, changed = Transition.REFUSED, {}
        self.state |= changed
        return [alarm(transition, **self.state, operator_name=request.operator_name, comment=request.comment)]


@pytest.fixture(scope="module")
def _installed() -> Path:
    return node_modules(PACKAGE, VERSION, WHAT)


@pytest.fixture(scope="module")
def scorer() -> Scorer:
    return Scorer()


@pytest.fixture(scope="module")
def opcua(_installed: Path, tmp_path_factory: pytest.TempPathFactory, scorer: Scorer) -> Iterator[RunningOpcua]:
    """One for all tests, in their order: a server takes seconds to start."""
    running = RunningOpcua(tmp_path_factory.mktemp("site"), scorer)
    try:
        yield running
    finally:
        running.close()


@pytest.fixture(scope="module")
def own_certificate(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the clients: they show one certificate, which takes seconds to make."""
    return tmp_path_factory.mktemp("client")


@pytest.fixture
def new_client(own_certificate: Path) -> Iterator[Callable[[], NodeOpcua]]:
    clients: list[NodeOpcua] = []

    def new() -> NodeOpcua:
        clients.append(NodeOpcua(own_certificate))
        return clients[-1]

    yield new
    for client in clients:
        client.close()


@pytest.mark.usefixtures("never_silent")
def test_it_browses_the_site_and_reads_values_with_their_quality_and_the_time_of_the_sample(opcua, new_client):
    opcua.feed(score())
    client = new_client()
    assert client.connect(opcua.url, OPERATOR, PASSWORD)["mode"] == "SignAndEncrypt"
    (site,) = [each for each in client("browse", node="ObjectsFolder") if each["name"] == SITE]
    assert [each["name"] for each in client("browse", node=site["id"])] == [TRAY]
    fans = client("browse", node=f"ns=2;s={TRAY}")
    assert [each["name"] for each in fans] == ["Fan0", "Fan1", "Fan2", "Fan3"]
    assert {each["type"] for each in fans} == {"ns=2;i=2"}
    parts = {each["name"]: each for each in client("browse", node=fans[0]["id"])}
    assert {"Speed", "PredictedSpeed", "BandHalfWidth", "Score", "State", "Judged", "Alarm"} <= parts.keys()
    unit = client("read", nodes=[f"ns=2;s={TRAY}/0/Speed/EngineeringUnits", f"ns=2;s={TRAY}/0/Speed/EURange"])
    assert unit[0]["value"]["unitId"] == 5394509
    assert unit[1]["value"]["high"] > 0
    names = ("Speed", "PredictedSpeed", "BandHalfWidth", "Score", "State", "Judged")

    def read(fan: int) -> dict[str, Any]:
        return dict(zip(names, client("read", nodes=[f"ns=2;s={TRAY}/{fan}/{name}" for name in names]), strict=True))

    eventually(lambda: read(0)["Speed"]["status"] == "Good", "the values are shown")
    judged, not_judged = read(0), read(3)
    assert judged["Speed"]["value"] == pytest.approx(1000.0, rel=1e-6)
    assert judged["Speed"]["t_ms"] == (NOW_NS + 40_000_000) // 1_000_000
    assert judged["PredictedSpeed"]["value"] == pytest.approx(1010.0, rel=1e-6)
    assert judged["BandHalfWidth"]["value"] == pytest.approx(20.0, rel=1e-6)
    assert (judged["Score"]["value"], judged["State"]["value"], judged["Judged"]["value"]) == (0.5, "normal", True)
    assert not_judged["Speed"]["status"] == "UncertainLastUsableValue", "samples are missing there"
    assert (not_judged["Score"]["status"], not_judged["Score"]["value"]) == ("BadNoData", None)
    assert (not_judged["State"]["value"], not_judged["Judged"]["value"]) == ("unknown: samples are missing", False)
    assert client("path", start=FAN, path="/2:Alarm/0:AckedState/0:Id") == [f"{ALARM}/AckedState/Id"]


@pytest.mark.usefixtures("never_silent")
def test_an_alarm_comes_is_refreshed_acknowledged_confirmed_and_shelved(opcua, new_client, scorer):
    opcua.feed(score(state=FanState.ALARM))
    client = new_client()
    client.connect(opcua.url, OPERATOR, PASSWORD)
    number = client("watch", nodes=[f"{ALARM}/ActiveState/Id", f"{FAN}/State"], notifier=SERVER)
    opcua.feed(alarm())
    seen: list[dict[str, Any]] = []

    def comes(what: str, found: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        def arrived() -> bool:
            seen.extend(client("events"))
            return any(found(each) for each in seen)

        eventually(arrived, what)
        return next(each for each in reversed(seen) if found(each))

    raised = comes("the alarm", lambda each: each["ActiveState.Id"] is True)
    assert (raised["SourceName"], raised["ConditionId"]) == (f"{TRAY}/2", ALARM)
    assert (raised["Severity"], raised["Retain"], raised["AckedState.Id"]) == (900, True, False)
    assert raised["2:Evidence"] == "drag +20 %"
    assert raised["2:Cause"] == "drag"

    assert client("acknowledge", condition=ALARM, event="00" * 16, comment="x") == "BadEventIdUnknown"
    assert client("acknowledge", condition=ALARM, event=raised["EventId"], comment="seen") == "Good"
    asked = scorer.asked[-1]
    assert (asked.operator_name, asked.comment, asked.fan) == (OPERATOR, "seen", 2)
    acknowledged = comes("the acknowledgement", lambda each: each["AckedState.Id"] is True)
    assert (acknowledged["Comment"], acknowledged["ClientUserId"]) == ("seen", OPERATOR)
    assert client("acknowledge", condition=ALARM, event=raised["EventId"], comment="again") == (
        "BadConditionBranchAlreadyAcked"
    )
    assert client("comment", condition=ALARM, event="00" * 16, comment="x") == "BadEventIdUnknown"
    assert client("comment", condition=ALARM, event=raised["EventId"], comment="the part is ordered") == "Good"
    commented = comes("the comment", lambda each: each["Comment"] == "the part is ordered")
    assert (commented["ClientUserId"], commented["AckedState.Id"]) == (OPERATOR, True), "nothing else has changed"
    assert client("comment", condition=ALARM, event=raised["EventId"], comment="") == "BadInvalidState"
    assert client("call", object=ALARM, method=DISABLE) == "BadNotImplemented"

    assert client("call", object=f"{ALARM}/ShelvingState", method=TIMED_SHELVE, inputs=[60_000]) == "Good"
    assert scorer.asked[-1].duration_s == 60.0
    shelved = comes("the shelving", lambda each: each["ShelvingState.CurrentState"] == "Timed Shelved")
    assert shelved["SuppressedOrShelved"] is True
    assert client("call", object=ALARM, method=UNSHELVE) == "Good", "also on the condition itself"
    assert client("call", object=ALARM, method=UNSHELVE) == "BadConditionNotShelved"
    assert client("call", object=ALARM, method=TIMED_SHELVE, inputs=[0]) == "BadShelvingTimeOutOfRange"
    assert client("call", object=ALARM, method=ONE_SHOT_SHELVE) == "Good"
    assert client("call", object=ALARM, method=REMOVE_FROM_SERVICE) == "Good"
    comes("the removal from service", lambda each: each["OutOfServiceState.Id"] is True)

    seen.clear()
    assert client("call", object=CONDITION_TYPE, method=REFRESH, inputs=[{"uint32": number}]) == "Good"
    comes("the end of the refresh", lambda each: each["EventType"] == "ns=0;i=2788")
    kinds = [(each["EventType"], each["SourceName"]) for each in seen]
    assert kinds == [("ns=0;i=2787", "Server"), ("ns=2;i=3", f"{TRAY}/2"), ("ns=0;i=2788", "Server")]

    def last(node: str) -> Any:
        return client("values")[node][-1]["value"]

    eventually(lambda: last(f"{ALARM}/ActiveState/Id") is True, "values that have changed come once a second")
    eventually(lambda: last(f"{FAN}/State").startswith("alarm"), "that of the fan, too")


def test_who_may_do_what(opcua, new_client, scorer):
    opcua.feed(score(), alarm())
    stranger, viewer, asked = new_client(), new_client(), len(scorer.asked)
    with pytest.raises(RuntimeError, match="BadUserAccessDenied"):
        viewer.connect(opcua.url, OPERATOR, "wrong wrong wrong")
    with pytest.raises(RuntimeError, match="BadSecurityModeInsufficient|BadIdentityToken"):
        viewer.connect(opcua.url, OPERATOR, PASSWORD, encrypted=False)
    stranger.connect(opcua.url, encrypted=False)
    viewer.connect(opcua.url, VIEWER, PASSWORD)
    for client in (stranger, viewer):
        assert client("read", nodes=[f"{ALARM}/ActiveState/Id"])[0]["value"] is True
        assert client("call", object=ALARM, method=REMOVE_FROM_SERVICE) == "BadUserAccessDenied"
        with pytest.raises(RuntimeError, match="BadUserAccessDenied"):
            client("write", node=f"{FAN}/Speed")
    assert len(scorer.asked) == asked


def test_a_client_that_hangs_holds_nobody_up(opcua, new_client):
    opcua.feed(score())
    hanging, other = new_client(), new_client()
    for client in (hanging, other):
        client.connect(opcua.url, VIEWER, PASSWORD)
        client("watch", nodes=[f"ns=2;s={TRAY}/0/Speed"], notifier=SERVER)
    hanging.pause(is_paused=True)
    sent = opcua.core.counters()["events_sent"]
    transitions = [alarm(Transition.DIAGNOSED, 2000 + number, message=f"fan 2: {number}") for number in range(1, 201)]
    for first in range(0, 200, 50):
        opcua.feed(*transitions[first : first + 50], score(first + 1.0))
    messages: list[str] = []

    def last_has_come() -> bool:
        messages.extend(each["Message"] for each in other("events"))
        return "fan 2: 200" in messages

    eventually(last_has_come, "the other client gets the last event")
    eventually(lambda: other("values")[f"ns=2;s={TRAY}/0/Speed"][-1]["t_ms"] > (NOW_NS // 10**6 + 100_000), "values")
    assert opcua.core.counters()["events_sent"] - sent == 200
    assert opcua.core.counters()["events_left_out"] == 0
    hanging.pause(is_paused=False)
    seen: list[str] = []

    def catches_up() -> bool:
        seen.extend(each["Message"] for each in hanging("events"))
        return "fan 2: 200" in seen

    eventually(catches_up, "it gets what has waited for it")
