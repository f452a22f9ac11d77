"""Files of `bus.security`: what cannot be used is refused in one line that says which file and why."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from fantwin.pipeline.bus.credentials import Credentials, checked_credentials, warning
from fantwin.pipeline.bus.errors import BusError
from fantwin.pipeline.bus.opening import zenoh_config
from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.certificates import CLOCK_SKEW, Authority, read_certificate
from fantwin.pipeline.config.settings import BusConfig
from tests.support.site_certificates import DAY, SiteCertificates


@pytest.fixture
def site(tmp_path: Path) -> SiteCertificates:
    made = SiteCertificates(tmp_path)
    made.issue("scorer")
    return made


def checked(site: SiteCertificates, *roles: str) -> Credentials:
    return checked_credentials(site.security, roles or ("scorer",))


def test_good_files_are_taken_and_say_their_role(site):
    found = checked(site)
    assert (found.role, found.own.hosts, found.warning()) == ("scorer", ("localhost", "127.0.0.1"), "")
    assert found.own.issuer == found.authority.role == "fantwin site"
    assert found.authority.is_authority
    assert not found.own.is_authority


def test_the_first_role_that_has_a_certificate_is_shown(site):
    assert checked(site, "scorer.tray1", "scorer").role == "scorer"
    site.issue("scorer.tray1")
    assert checked(site, "scorer.tray1", "scorer").role == "scorer.tray1"


MINUTE = timedelta(minutes=1)
HARMS: list[tuple[Callable[[SiteCertificates], object], list[str]]] = [
    (lambda site: (site.folder / "ca.pem").unlink(), ["ca.pem", "No such file"]),
    (lambda site: (site.folder / "scorer.pem").unlink(), ["scorer.pem", "no such certificate", "certs issue"]),
    (
        lambda site: site.issue("scorer", authority=Authority.new("site", DAY)),
        ["scorer.pem", "not signed by"],
    ),
    (lambda site: site.issue("scorer", lifetime=-MINUTE), ["scorer.pem", "expired on", "certs renew scorer"]),
]


@pytest.mark.parametrize(("harm", "words"), HARMS)
def test_what_cannot_be_used_is_one_line_that_says_what_to_do(site, harm, words):
    harm(site)
    with pytest.raises(BusError) as refused:
        checked(site)
    assert "\n" not in str(refused.value)
    assert all(word in str(refused.value) for word in words), str(refused.value)


def test_a_certificate_is_not_valid_before_its_time_and_warned_of_before_its_end(site):
    own = read_certificate(site.folder / "scorer.pem")
    made = own.not_before + CLOCK_SKEW
    assert abs(made - datetime.now(UTC)) < timedelta(minutes=1)
    assert "not valid before" in own.time_problem(own.not_before - timedelta(seconds=1))
    assert own.warning(made) == own.warning(own.not_after - 0.21 * (own.not_after - own.not_before)) == ""
    assert "expires in 24 hours" in own.warning(own.not_after - DAY)
    assert warning(own) == ""
    assert "expired on" in own.warning(own.not_after)


def test_a_long_lifetime_is_warned_of_thirty_days_before_its_end(tmp_path):
    site = SiteCertificates(tmp_path, Authority.new("site", 800 * DAY))
    site.issue("scorer", lifetime=400 * DAY)
    own = read_certificate(tmp_path / "scorer.pem")
    assert own.warning(own.not_after - 31 * DAY) == ""
    assert "expires in 29 days" in own.warning(own.not_after - 29 * DAY)


def test_no_certificate_outlives_its_authority(site):
    site.issue("scorer", lifetime=1000 * DAY)
    found = checked(site)
    assert timedelta() <= found.authority.not_after - found.own.not_after < timedelta(seconds=5)


@pytest.mark.parametrize(
    ("scheme", "is_secure", "words"),
    [("tcp", True, "with [bus.security] write tls/127.0.0.1:1"), ("tls", False, "tls needs certificates")],
)
def test_tls_and_certificates_go_together(site, scheme, is_secure, words):
    config = BusConfig(endpoint=f"{scheme}/127.0.0.1:1", security=site.security if is_secure else None)
    with pytest.raises(BusError) as refused:
        Bus(config, roles=("scorer",))
    assert words in str(refused.value)


def test_settings_of_zenoh_are_passed_through(endpoint):
    config = zenoh_config(BusConfig(zenoh={"transport/unicast/max_sessions": 7}), listens=False)
    assert config.get_json("transport/unicast/max_sessions") == "7"
    with pytest.raises(BusError, match="'transport/unicast/max_sessions': Zenoh does not take 'many'"):
        Bus(BusConfig(endpoint=endpoint, zenoh={"transport": {"unicast": {"max_sessions": "many"}}}))
