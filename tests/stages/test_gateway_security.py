"""The gateway under attack: guesses, sessions that should be over, connections that are held, headers that lie."""

from __future__ import annotations

import asyncio
import http.client
import json
import ssl
import threading
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
from starlette.requests import Request

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.outputs.web.live_feed import SharedAnswer
from fantwin.pipeline.site import security_log
from fantwin.pipeline.site.users import UserRole, new_token, read_accounts, write_accounts
from tests.support.running_core import TRAY
from tests.support.running_gateway import Client, RunningGateway
from tests.support.site_certificates import SiteCertificates
from tests.support.site_messages import SCRIPT, alarm, granted, score
from tests.support.site_users import PASSWORD, make_users

pytestmark = pytest.mark.usefixtures("quickly_hashed")
ACT, ASKED = f"/api/v1/fans/{TRAY}/2/requests", {"action": "acknowledge"}
OTHER_PASSWORD = "another horse battery"


@pytest.fixture
def users(tmp_path: Path) -> Path:
    return make_users(tmp_path / "users.toml", ann=UserRole.OPERATOR, vic=UserRole.VIEWER)


@pytest.fixture
def gateway(opened: Callable[..., RunningGateway], tmp_path: Path, users: Path) -> RunningGateway:
    return opened(tmp_path, granted, users=users)


def logged_in(gateway: RunningGateway, name: str = "ann") -> Client:
    client = Client(gateway)
    assert client.log_in(name, PASSWORD) == 200
    return client


def events(gateway: RunningGateway, **headers: str) -> http.client.HTTPResponse:
    connection = http.client.HTTPConnection("127.0.0.1", gateway.port, timeout=30)
    connection.request("GET", "/api/v1/events", headers=headers)
    return connection.getresponse()


def said(capfd: pytest.CaptureFixture[str]) -> list[dict[str, Any]]:
    lines = [line.partition("event: ") for line in capfd.readouterr().err.splitlines()]
    return [json.loads(text) for before, sign, text in lines if sign and not before]


def test_a_login_holds_nobody_up_and_guesses_side_by_side_are_as_few_as_one_after_the_other(gateway, monkeypatch):
    goes_on, is_checking = threading.Event(), threading.Event()

    def slowly(*_rest: object) -> bool:
        is_checking.set()
        assert goes_on.wait(30)
        return False

    monkeypatch.setattr("fantwin.pipeline.site.users.Users.is_password", slowly)
    answers: list[int] = []
    guesses = [
        threading.Thread(target=lambda: answers.append(Client(gateway).log_in("ann", "wrong wrong wrong")))
        for _ in range(12)
    ]
    for each in guesses:
        each.start()
    assert is_checking.wait(30)
    assert Client(gateway).ask("GET", "/api/v1/site")[0] == 200, "while a password is being checked"
    goes_on.set()
    for each in guesses:
        each.join()
    assert sorted(answers) == [401] * security_log.FAILURES + [429] * (12 - security_log.FAILURES)


def test_logging_in_to_an_own_account_buys_no_guesses_and_guesses_from_elsewhere_lock_out_no_logged_in_user():
    now_s, most = 0.0, security_log.FAILURES
    failures = security_log.LoginFailures(lambda: now_s)
    failures.succeed("ann", "192.0.2.7")
    for number in range(most):
        assert failures.begin(f"user{number}", f"2001:db8::{number}") == 0
        assert failures.begin("ann", f"198.51.100.{number}") == 0
        failures.begin("vic", "192.0.2.1")
        failures.succeed("vic", "192.0.2.1")
    assert failures.begin("bob", "2001:db8::ffff") > 0, "an IPv6 network counts as one address"
    assert failures.begin("ann", "198.51.100.77") > 0, "the account has had its guesses"
    assert failures.begin("ann", "192.0.2.7") == 0, "where she has logged in"
    failures.succeed("ann", "192.0.2.7")
    guesses = sum(failures.begin("ann", "192.0.2.7") == 0 for _ in range(20))
    assert guesses == most, "no more than others have"
    guesses = 0
    while now_s < 3600:
        guesses += failures.begin("bob", "192.0.2.9") == 0
        now_s += 1
    assert guesses <= 100, "in an hour"


def test_a_new_password_and_another_login_end_the_session_of_before(gateway, users, monkeypatch):
    monkeypatch.setattr("fantwin.pipeline.outputs.web.access.MOST_OF_A_USER", 2)
    first, viewers = logged_in(gateway), [logged_in(gateway, "vic") for _ in range(3)]
    assert [each.ask("GET", "/api/v1/me")[1]["name"] for each in viewers] == ["", "vic", "vic"], "his own only"
    assert first.ask("GET", "/api/v1/me")[1]["name"] == "ann"
    again = Client(gateway)
    again.cookie = first.cookie
    assert again.log_in("ann", PASSWORD) == 200
    assert first.ask("POST", ACT, ASKED)[0] == 401, "this browser has logged in again"
    assert again.ask("POST", ACT, ASKED)[0] == 200
    make_users(users, OTHER_PASSWORD, ann=UserRole.OPERATOR)
    assert again.ask("POST", ACT, ASKED)[0] == 401
    assert len(gateway.sent) == 1


def token(users: Path, name: str = "grafana", role: UserRole = UserRole.VIEWER, **left: float) -> dict[str, str]:
    """The header of a program whose token is added to the file."""
    accounts = read_accounts(users)
    text, accounts.tokens[name] = new_token(name, role, datetime.now(UTC) + timedelta(**left) if left else None)
    write_accounts(users, accounts)
    assert text not in users.read_text(encoding="utf-8")
    return {"Authorization": f"Bearer {text}"}


@pytest.mark.parametrize(
    ("role", "left", "reads", "acts"),
    [
        (UserRole.VIEWER, {}, 200, 403),
        (UserRole.OPERATOR, {"days": 1}, 200, 200),
        (UserRole.OPERATOR, {"days": -1}, 401, 401),
    ],
    ids=["viewer", "operator", "ended"],
)
def test_a_program_reads_and_acts_by_the_role_of_its_token_without_a_session(
    gateway, users, monkeypatch, role, left, reads, acts
):
    monkeypatch.setattr("fantwin.pipeline.outputs.web.config.GatewayConfig.is_loopback", False)
    gateway.feed(score(), alarm())
    program = token(users, role=role, **left)
    assert Client(gateway).ask("GET", "/api/v1/fans")[0] == 401, "nobody reads without one"
    for path in ("/api/v1/fans", "/metrics"):
        assert Client(gateway).ask("GET", path, headers=program)[0] == reads
    assert Client(gateway).ask("POST", ACT, ASKED, headers=program)[0] == acts
    assert [each.operator_name for each in gateway.sent] == (["grafana"] if acts == 200 else [])
    foreign = {**program, "Origin": "http://evil.example", "Sec-Fetch-Site": "cross-site"}
    assert Client(gateway).ask("POST", ACT, ASKED, headers=foreign)[0] == 403, "no page of another site acts with it"


def test_a_token_that_is_removed_or_made_up_is_refused_even_where_nobody_logs_in_and_guesses_must_wait(
    gateway, users, capfd, monkeypatch
):
    monkeypatch.setattr("fantwin.pipeline.outputs.web.live_feed.CHECKED_EVERY_S", 0.0)
    gateway.feed(score())
    program, other = token(users), token(users, "other")
    stream = events(gateway, **program)
    assert stream.readline() == b"event: fleet\n"
    accounts = read_accounts(users)
    del accounts.tokens["grafana"]
    write_accounts(users, accounts)
    while stream.readline():
        gateway.feed(alarm())  # live events end with it
    answers = [Client(gateway).ask("GET", "/api/v1/site", headers=program) for _ in range(6)]
    refused = [status for status, _, _ in answers]
    assert refused == sorted(refused) and refused[0] == 401 and refused[-1] == 429
    assert int(answers[-1][2]["retry-after"]) > 0
    assert Client(gateway).ask("GET", "/api/v1/site", headers=other)[0] == 200, "the right one need not wait"
    assert {"what": "token refused", "path": "/api/v1/site", "address": "127.0.0.1"}.items() <= said(capfd)[-1].items()
    users.chmod(0o644)
    status, answer, _ = Client(gateway).ask("GET", "/api/v1/site", headers=other)
    assert (status, "the file of users cannot be read" in answer["error"]) == (503, True)
    assert "with a token neither" in gateway.problem()


@pytest.mark.parametrize(
    ("break_it", "why"),
    [
        (lambda path: path.chmod(0o644), "others may read it: chmod 600"),
        (lambda path: path.write_text("[ann", encoding="utf-8"), "the users cannot be read"),
    ],
)
def test_while_the_file_of_users_cannot_be_used_nobody_acts_or_logs_in(gateway, users, break_it, why):
    operator, text = logged_in(gateway), users.read_text(encoding="utf-8")
    break_it(users)
    assert operator.ask("POST", ACT, ASKED)[0] == 401
    status, answer, _ = Client(gateway).ask("POST", "/api/v1/login", {"name": "ann", "password": PASSWORD})
    assert (status, "the file of users cannot be read" in answer["error"]) == (503, True)
    assert why in gateway.problem()
    assert Client(gateway).ask("GET", "/api/v1/site")[0] == 200, "on this host whoever looks needs no login"
    users.write_text(text, encoding="utf-8")
    users.chmod(0o600)
    assert operator.ask("POST", ACT, ASKED)[0] == 401, "the session is over"
    assert logged_in(gateway).ask("POST", ACT, ASKED)[0] == 200
    assert gateway.problem() == ""


def test_live_events_end_for_who_may_not_read_any_more(gateway, users, monkeypatch):
    monkeypatch.setattr("fantwin.pipeline.outputs.web.live_feed.CHECKED_EVERY_S", 0.0)
    monkeypatch.setattr("fantwin.pipeline.outputs.web.config.GatewayConfig.is_loopback", False)
    gateway.feed(score())
    assert events(gateway).status == 401
    stream = events(gateway, Cookie=logged_in(gateway, "vic").cookie)
    assert stream.readline() == b"event: fleet\n"
    make_users(users, ann=UserRole.OPERATOR)
    while stream.readline():
        pass
    assert stream.isclosed()


def test_through_a_proxy_that_knows_no_users_nobody_reads_without_a_login(opened, tmp_path, users, gateway):
    assert Client(gateway).ask("GET", "/api/v1/site")[0] == 200
    assert Client(gateway).ask("GET", "/api/v1/site", None, {"X-Forwarded-For": "192.0.2.1"})[0] == 401
    named = opened(tmp_path / "named", users=users, hosts=("fans.plant.example",))
    client, host = Client(named), {"Host": "fans.plant.example"}
    assert client.ask("GET", "/api/v1/site", None, host)[0] == 401
    assert client.ask("GET", "/metrics", None, host)[0] == 401
    own = {"Host": f"localhost:{named.port}"}, {"Host": f"[::1]:{named.port}"}
    assert [client.ask("GET", "/healthz", None, each)[0] for each in ({}, *own)] == [200, 200, 200]
    assert client.ask("GET", "/healthz", None, {"Host": "evil.example"})[0] == 400
    assert logged_in(gateway).ask("GET", "/api/v1/site")[0] == 200


def test_behind_a_published_port_of_loopback_all_on_the_host_read_and_behind_a_proxy_that_ends_tls_users_alone(
    opened, tmp_path, users
):
    published = Client(opened(tmp_path / "published", host="0.0.0.0", in_front="loopback"))
    assert published.ask("GET", "/api/v1/site")[0] == 200
    assert published.ask("GET", "/api/v1/site", None, {"Host": "evil.example"})[0] == 400, "a name bound to loopback"
    behind = Client(opened(tmp_path / "behind", granted, host="0.0.0.0", in_front="tls", users=users))
    named = {"Host": "fans.plant.example"}
    status, _, headers = behind.ask("GET", "/api/v1/site", None, named)
    assert (status, "strict-transport-security" in headers) == (401, True)
    _, _, headers = behind.ask("POST", "/api/v1/login", {"name": "ann", "password": PASSWORD}, named)
    assert headers["set-cookie"].startswith("__Host-fantwin=") and "Secure" in headers["set-cookie"]


def test_what_fails_in_the_gateway_is_logged_and_says_nothing_to_whoever_asks(gateway, capfd, monkeypatch):
    assert Client(gateway).ask("POST", "/api/v1/login", {}, {"Origin": "http://["})[0] == 403
    said(capfd)

    def fail(*_rest: object) -> None:
        raise RuntimeError("the secret")

    monkeypatch.setattr(gateway.core._model, "stages", fail)
    status, body, headers = Client(gateway).ask("GET", "/api/v1/stages")
    assert (status, "secret" in json.dumps(body)) == (500, False)
    assert "default-src 'none'" in headers["content-security-policy"]
    (event,) = said(capfd)
    assert (event["what"], event["path"], event["address"]) == ("gateway failed", "/api/v1/stages", "127.0.0.1")
    assert event["why"] == "RuntimeError: the secret"
    monkeypatch.setattr(gateway.core._model.past, "newest", Mock(side_effect=UserError("alarms.sqlite is damaged")))
    assert Client(gateway).ask("GET", "/api/v1/alarms/history")[0] == 503


def test_logins_refusals_and_requests_are_logged_a_line_each_and_a_comment_is_one_line(gateway, capfd):
    gateway.feed(score(), alarm())
    Client(gateway).log_in('ann"}\nevent: {', "wrong wrong wrong")
    viewer, operator = logged_in(gateway, "vic"), logged_in(gateway)
    viewer.ask("POST", ACT, ASKED)
    operator.ask("POST", ACT, ASKED, {"X-CSRF-Token": "another"})
    comment = f"é 扇 \U0001f600 {SCRIPT}\x1b[2J\r\nfan 3: \u202etxet\x00\x9b"
    assert operator.ask("POST", ACT, ASKED | {"comment": comment})[0] == 200
    operator.ask("POST", "/api/v1/logout", {})
    found = said(capfd)
    assert [(each["what"], each["user"]) for each in found] == [
        ("login refused: wrong name or password", 'ann"}\nevent: {'),
        ("login", "vic"),
        ("login", "ann"),
        ("request refused", "vic"),
        ("request refused", "ann"),
        ("request", "ann"),
        ("logout", "ann"),
    ]
    assert (found[5]["action"], found[5]["fan"], found[5]["address"]) == ("acknowledge", f"{TRAY} 2", "127.0.0.1")
    assert PASSWORD not in json.dumps(found)
    assert gateway.sent[0].comment == f"é 扇 \U0001f600 {SCRIPT} [2J  fan 3:  txet  ", "it shows what it says"


def test_by_https_the_cookie_goes_at_logout_and_a_certificate_that_is_over_is_named(opened, tmp_path, users):
    certificates = SiteCertificates(tmp_path)
    certificates.issue("page", lifetime=timedelta(seconds=-1))
    files = {"certificate": tmp_path / "page.pem", "key": tmp_path / "page.key"}
    gateway = opened(tmp_path, users=users, **files)
    gateway.feed(score())
    unchecked = ssl.create_default_context()
    unchecked.check_hostname, unchecked.verify_mode = False, ssl.CERT_NONE
    connection = http.client.HTTPSConnection("127.0.0.1", gateway.port, timeout=30, context=unchecked)
    form = json.dumps({"name": "ann", "password": PASSWORD})
    connection.request("POST", "/api/v1/login", form, {"Content-Type": "application/json"})
    answer = connection.getresponse()
    token, cookie = json.loads(answer.read())["csrf_token"], answer.getheader("set-cookie", "")
    assert cookie.startswith("__Host-fantwin=")
    assert "; Secure" in cookie
    headers = {"Cookie": cookie.partition(";")[0], "X-CSRF-Token": token}
    connection.request("POST", "/api/v1/logout", headers=headers)
    answer = connection.getresponse()
    gone = answer.getheader("set-cookie", "")
    assert "Max-Age=0" in gone
    assert "; Secure" in gone, "browsers refuse a cookie of this name without it"
    connection.close()
    assert "page.pem: expired on" in gateway.problem()


def test_pages_that_ask_at_once_share_one_answer_which_is_never_older_than_the_question():
    goes_on, made = threading.Event(), list[int]()

    def make() -> int:
        made.append(len(made))
        assert goes_on.wait(30)
        return made[-1]

    async def all_ask() -> list[int]:
        shared, request = SharedAnswer(make), Request({"type": "http", "headers": []})
        pages = [asyncio.create_task(shared.to(request))]
        while not made:
            await asyncio.sleep(0.001)
        pages += [asyncio.create_task(shared.to(request)) for _ in range(8)]
        asyncio.get_running_loop().call_soon(goes_on.set)
        return [int((await each).body) for each in pages]

    assert asyncio.run(all_ask()) == [0] + [1] * 8


def test_every_answer_forbids_foreign_scripts_and_the_cookie_is_for_the_server_only(gateway):
    client = Client(gateway)
    _, _, headers = client.ask("POST", "/api/v1/login", {"name": "ann", "password": PASSWORD})
    cookie = headers["set-cookie"].lower()
    assert "httponly" in cookie
    assert "samesite=strict" in cookie
    for path in ("/", "/page/main.js", "/api/v1/site", "/api/v1/nothing", "/metrics"):
        _, _, headers = client.ask("GET", path)
        assert "default-src 'none'" in headers["content-security-policy"], path
        assert headers["x-content-type-options"] == "nosniff"
    assert client.ask("GET", "/page/../app.py")[0] == 404
