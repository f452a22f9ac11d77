"""`fantwin certs`: an authority and certificates in a few commands; nothing is lost by a second one."""

from __future__ import annotations

import json
import stat
from datetime import UTC, date, datetime, timedelta
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from fantwin.pipeline.bus.credentials import checked_credentials
from fantwin.pipeline.certificates import Authority, is_host, write_pair
from fantwin.pipeline.cli import main as command_line
from fantwin.pipeline.config.loading import load_config
from fantwin.pipeline.errors import UserError
from tests.support.site_certificates import SiteCertificates

CONFIG = """
site = "plant"
[bus]
mode = "client"
endpoint = "tls/router.example:7447"
[bus.security]
controllers = ["dcim"]
[[tray]]
name = "tray1"
fans = 4
twin = "twin.onnx"
[[tray]]
name = "tray2"
fans = 4
twin = "twin.onnx"
"""


@pytest.fixture(scope="module", autouse=True)
def _the_command() -> None:
    if "certs" not in {command.name for command in command_line.app.registered_commands}:
        command_line._register(["certs", "router"])


@pytest.fixture
def path(tmp_path: Path) -> Path:
    file = tmp_path / "fantwin.toml"
    file.write_text(CONFIG)
    return file


def certs(path: Path, *words: str) -> Result:
    return CliRunner().invoke(command_line.app, ["certs", *words, "-c", str(path)], env={"COLUMNS": "200"})


def made(result: Result) -> list[str]:
    assert result.exit_code == 0, result.exception
    return [each["role"] for each in json.loads(result.stdout)["made"]]


def mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def test_from_nothing_to_certificates_that_every_process_can_use(path):
    assert certs(path, "init").exit_code == 0
    roles = made(certs(path, "issue", "--json"))
    assert {"acquisition", "scorer", "recorder", "router", "operator", "viewer"} <= set(roles)
    security = load_config(path, stages=()).bus.security
    assert security
    for role in roles:
        credentials = checked_credentials(security, (role,))
        assert credentials.role == role
        assert {"localhost", "127.0.0.1", "router.example"} <= set(credentials.own.hosts)
        assert mode(credentials.key) == 0o600
    authority = path.parent / "authority"
    assert (mode(authority), mode(authority / "ca.key")) == (0o700, 0o600)
    assert not (path.parent / "certs" / "ca.key").exists()
    result = certs(path, "show")
    assert result.exit_code == 0
    assert all(role in result.stdout for role in roles)
    line = next(line for line in result.stdout.splitlines() if line.split()[:1] == ["operator"])
    until, days = line.split()[1:3]
    assert date.fromisoformat(until) - datetime.now(UTC).date() == timedelta(days=int(days)) == timedelta(days=397)


@pytest.mark.parametrize("is_pushed", [False, True])
def test_a_program_that_pushes_samples_gets_a_certificate_where_a_tray_takes_them(path, is_pushed):
    path.write_text(CONFIG + ('source = { kind = "push" }\n' if is_pushed else ""))
    certs(path, "init")
    assert ("source" in made(certs(path, "issue", "--json"))) == is_pushed


def test_nothing_is_replaced_without_being_asked(path):
    certs(path, "init")
    certs(path, "issue")
    key, authority = path.parent / "certs" / "scorer.key", path.parent / "authority" / "ca.key"
    before = key.read_bytes(), authority.read_bytes()
    for words in (["init"], ["issue", "scorer"]):
        result = certs(path, *words)
        assert isinstance(result.exception, UserError)
        assert "--replace" in str(result.exception)
    assert made(certs(path, "issue", "--json")) == []
    assert (key.read_bytes(), authority.read_bytes()) == before
    assert made(certs(path, "issue", "scorer", "--replace", "--json")) == ["scorer"]
    assert key.read_bytes() != before[0]


def test_a_renewed_certificate_keeps_its_role_and_hosts_and_has_a_new_key(path):
    certs(path, "init")
    certs(path, "issue", "acquisition", "--tray", "tray2", "--host", "press.example", "--days", "7")
    key = path.parent / "certs" / "acquisition.tray2.key"
    before = key.read_bytes()
    result = json.loads(certs(path, "renew", "--json").stdout)["made"]
    assert [each["role"] for each in result] == ["acquisition.tray2"]
    assert "press.example" in result[0]["hosts"]
    assert key.read_bytes() != before
    assert mode(key) == 0o600


def test_a_renewed_certificate_is_valid_for_as_long_as_the_one_before_and_needs_the_one_of_its_authority(path):
    certs(path, "init")
    folder = path.parent / "certs"
    signed, key = Authority.read(path.parent / "authority").issue("viewer", ["localhost"], timedelta(hours=12))
    write_pair(folder / "viewer.pem", folder / "viewer.key", signed, key, replace=False)
    assert made(certs(path, "renew", "viewer", "--json")) == ["viewer"]
    assert certs(path, "show").exit_code == 0
    (folder / "ca.pem").unlink()
    assert str(certs(path, "renew", "viewer").exception).endswith("`fantwin certs init` makes it")


def test_an_expired_certificate_is_shown_and_ends_the_command_with_1(path):
    SiteCertificates(path.parent / "certs").issue("viewer", lifetime=-timedelta(minutes=1))
    result = certs(path, "show")
    assert result.exit_code == 1
    assert "viewer.pem: expired on" in result.stdout


@pytest.mark.parametrize("host", ["a b", "", "10.0.0.0/8", "-a", "a..b", "x" * 64])
def test_a_host_that_cannot_be_one_is_none(host):
    assert not is_host(host)


def test_a_name_or_an_address_of_a_host_is_in_the_certificate(path):
    hosts = ["plant-router.example", "10.0.0.8", "fd00::8", "xn--mnchen-3ya", "*.plant.example"]
    certs(path, "init")
    made(certs(path, "issue", "router", *(word for host in hosts for word in ("--host", host)), "--json"))
    (shown,) = json.loads(certs(path, "show", "router", "--json").stdout)
    assert set(hosts) <= set(shown["hosts"])


@pytest.mark.parametrize("content", [b"", b"\xff\xfe"])
def test_a_file_of_others_is_named_and_the_rest_is_shown_and_renewed_but_a_damaged_one_is_not_passed_over(
    path, content
):
    certs(path, "init")
    certs(path, "issue", "router")
    (path.parent / "certs" / "a-foreign.pem").write_bytes(content)
    done = certs(path, "show", "--json")
    assert [each["role"] for each in json.loads(done.stdout)] == ["fantwin plant", "router"]
    assert done.stderr.count("\n") == 1 and "a-foreign.pem" in done.stderr
    assert made(certs(path, "renew", "--json")) == ["router"]
    (path.parent / "certs" / "router.pem").write_bytes(b"damaged")
    done = certs(path, "show")
    assert isinstance(done.exception, UserError) and "router.pem" in str(done.exception)
