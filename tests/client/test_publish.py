"""A client publishes samples: each arrives once, or an error or a count says why not."""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import fantwin.client
from fantwin.client import (
    BusError,
    Client,
    ClientError,
    CommandError,
    FanCountError,
    NoAcquisitionError,
    NotKeptError,
    SendError,
    TimeOrderError,
    Tray,
)
from fantwin.client.outbox import MOST_SENT_MESSAGES
from fantwin.client.times import times_ns
from fantwin.pipeline.bus.credentials import checked_credentials
from fantwin.pipeline.bus.rights import SiteRoles
from fantwin.pipeline.bus.router import open_router
from fantwin.pipeline.config.loading import parse_config
from fantwin.schemas.topics import BY_NAME
from tests.support.running_acquisition import SITE, TRAY, Raws, acquisition, push_config, raws_of
from tests.support.running_chain import eventually
from tests.support.secured_site import SecuredSite, free_endpoint
from tests.support.site_certificates import SiteCertificates

RPM = 2 * np.pi / 60
T_S = 1_790_000_000.0


@pytest.fixture
def raws(endpoint: str) -> Iterator[Raws]:
    with raws_of(endpoint) as raws:
        yield raws


@pytest.fixture
def client(endpoint: str, raws: Raws) -> Iterator[Client]:
    client = fantwin.client.connect(endpoint, site=SITE)
    yield client
    client.close(timeout_s=0.5)


def test_samples_arrive_with_their_times_numbers_and_units(endpoint: str, raws: Raws, tmp_path: Path) -> None:
    with acquisition(push_config(endpoint, tmp_path)), fantwin.client.connect(endpoint, site=SITE) as client:
        tray = client.tray(TRAY, speed_unit="rpm")
        assert tray.fans == 2 and tray.fan_names == ("", "")
        tray.publish(T_S, command=[0.25, 0.5], speed=[1500.0, np.nan])
        tray.publish(round((T_S + 0.01) * 1e9), command=[0.25, 0.5], speed=[1501.0, 2000.0])
        tray.publish(datetime.fromtimestamp(T_S + 0.02, UTC), command=[0.3, 0.5], speed=[1502.0, 2001.0])
        t_s = T_S + np.arange(3, 103) / 100
        tray.publish(t_s, command=np.full((100, 2), 0.4), speed=np.linspace(1503, 1602, 200).reshape(100, 2))
        t_s = T_S + np.array([1.03, 1.04])
        tray.publish(
            t_s, np.full((2, 2), 0.4), np.ones((2, 2)), supply_voltage_v=12.0, current_a=[[0.5, 0.6], [0.7, 0.8]]
        )
        losses = tray.check()
        assert (losses.published, losses.received, losses.waiting, losses.any) == (105, 105, 0, False)
    raws.wait_for(105)
    measured = [message for message in raws.messages if len(message.supply_voltage_v)]
    assert np.concatenate([message.supply_voltage_v for message in measured]).tolist() == [[12.0, 12.0]] * 2
    current_a = np.concatenate([message.current_a for message in measured])
    np.testing.assert_allclose(current_a, [[0.5, 0.6], [0.7, 0.8]], rtol=1e-6)
    assert not any(len(message.temperature_c) for message in raws.messages)
    clock_us = raws.column("device_clock_us").astype(np.int64)
    assert clock_us[0] == T_S * 1e6 % 2**32
    np.testing.assert_array_equal(np.diff(clock_us) % 2**32, 10_000)
    np.testing.assert_array_equal(raws.column("device_sequence"), np.arange(105))
    np.testing.assert_allclose(raws.column("speed_rad_s")[:2], np.array([[1500, np.nan], [1501, 2000]]) * RPM)
    np.testing.assert_array_equal(raws.column("command")[:3], [[0.25, 0.5], [0.25, 0.5], [0.3, 0.5]])


def test_what_cannot_be_a_sample_of_the_tray_is_refused_at_once(
    endpoint: str, client: Client, raws: Raws, tmp_path: Path
) -> None:
    with acquisition(push_config(endpoint, tmp_path, '["CPU", "rear top"]')):
        tray = client.tray(TRAY)
        assert tray.fan_names == ("CPU", "rear top")
        tray.publish(T_S, [0.5, 0.5], [1.0, 1.0])
        with pytest.raises(FanCountError, match=r"command has shape \(3,\); 1 samples of 2 fans have shape \(1, 2\)"):
            tray.publish(T_S + 1, [0.5] * 3, [1.0] * 3)
        with pytest.raises(FanCountError, match="speed has shape"):
            tray.publish(T_S + 1, [0.5] * 2, [1.0])
        with pytest.raises(CommandError, match=r"command nan of rear top \(fan 1\), sample 0"):
            tray.publish(T_S + 1, [0.5, np.nan], [1.0, 1.0])
        with pytest.raises(CommandError, match="within command_min = 0 to command_max = 1"):
            tray.publish(T_S + 1, [1.5, 0.5], [1.0, 1.0])
        tray.publish(T_S + 1, np.array([1.0, 0.1], np.float32), [1.0, 1.0])
        for t in (T_S, T_S + 1, [T_S + 2, T_S + 2]):
            with pytest.raises(TimeOrderError, match="times must increase"):
                tray.publish(t, np.full((np.size(t), 2), 0.5), np.full((np.size(t), 2), 1.0))
        for t, words in (
            (datetime(2026, 1, 1), "without a time zone"),
            (np.nan, "no time"),
            ("now", "give seconds"),
            (datetime(2200, 1, 1, tzinfo=UTC), "2200-01-01 .*: beyond the year 2116"),
            (np.datetime64("3000-01-01"), "3000-01-01: beyond the year 2116"),  # wraps to 1830 in ns
        ):
            with pytest.raises(TimeOrderError, match=words):
                tray.publish(t, [0.5, 0.5], [1.0, 1.0])  # type: ignore[arg-type]
        tray.restart_time()
        tray.publish(T_S - 100, [0.5, 0.5], [1.0, 1.0])
        assert tray.check().received == 3
        tray.publish(T_S - 99, [0.5, 0.5], [30_000.0, 1.0])
        assert tray.check().absurd_speeds == 1, "no sample is lost by that"


def test_what_ends_the_thread_is_raised_by_publish_and_check(
    endpoint: str, raws: Raws, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with acquisition(push_config(endpoint, tmp_path)):
        client = fantwin.client.connect(endpoint, site=SITE)
        tray = client.tray(TRAY)
        monkeypatch.setattr("fantwin.client.tray.encode", lambda _message: 1 / 0)
        tray.publish(T_S, [0.5, 0.5], [1.0, 1.0])
        with pytest.raises(SendError, match="ZeroDivisionError: division by zero; open the client again") as caught:
            tray.check(60.0)
        assert isinstance(caught.value.__cause__, ZeroDivisionError)
        with pytest.raises(SendError):
            tray.publish(T_S + 1, [0.5, 0.5], [1.0, 1.0])
        with pytest.raises(SendError):
            client.close()


def test_without_such_a_tray_one_line_says_so(endpoint: str, client: Client, raws: Raws, tmp_path: Path) -> None:
    before = len(client._bus._declared)
    for _ in range(2):
        with pytest.raises(NoAcquisitionError, match="no acquisition of tray tray1 of site plant is at work"):
            client.tray(TRAY, timeout_s=0.1)
    assert len(client._bus._declared) == before, "a program may try for as long as it runs"
    with pytest.raises(ClientError, match="speed_unit 'RPM' is not known; known: .*rpm"):
        client.tray(TRAY, speed_unit="RPM")  # pyright: ignore[reportArgumentType]
    with (
        acquisition(push_config(endpoint, tmp_path, source='{ kind = "serial", port = "no" }')),
        pytest.raises(NoAcquisitionError, match='takes no pushed samples: write source = { kind = "push" }'),
    ):
        client.tray(TRAY)


def test_a_program_may_start_before_the_site(endpoint: str, client: Client, raws: Raws, tmp_path: Path) -> None:
    taken: list[Tray] = []
    program = threading.Thread(target=lambda: taken.append(client.tray(TRAY, speed_unit="rpm", timeout_s=math.inf)))
    program.start()
    with acquisition(push_config(endpoint, tmp_path)):
        program.join(30.0)
        (tray,) = taken
        tray.publish(T_S, [0.5, 0.5], [1500.0, 1500.0])
        assert tray.check().received == 1


def test_an_acquisition_that_is_restarted_gets_what_was_published_meanwhile(
    endpoint: str, client: Client, raws: Raws, tmp_path: Path
) -> None:
    config = push_config(endpoint, tmp_path)
    with acquisition(config):
        tray = client.tray(TRAY, kept_samples=100)
        for number in range(10):
            tray.publish(T_S + number / 1000, [0.5, 0.5], [1.0, 1.0])
        tray.check()
        raws.wait_for(10)
    for number in range(10, 110):
        tray.publish(T_S + number / 1000, [0.5, 0.5], [1.0, 1.0])
    assert (tray.losses().received, tray.losses().waiting) == (10, 100)
    with pytest.raises(NotKeptError, match="100 are kept at most: acquisition is gone.*; 1 samples were not taken"):
        tray.publish(T_S + 11, [0.5, 0.5], [1.0, 1.0])
    with pytest.raises(fantwin.client.NotReceivedError, match="has not received 100 of 110 samples"):
        tray.check(timeout_s=0)
    with acquisition(config):
        tray.wait_received(10)
        raws.wait_for(110)
        assert tray.losses().not_kept == 1
        with pytest.raises(fantwin.client.SamplesLostError, match="1 not kept"):
            tray.check()
    np.testing.assert_array_equal(raws.column("device_sequence"), np.arange(110))
    # kept samples are not late: they count as received when they would have been, had they been sent at once
    np.testing.assert_allclose(np.diff(raws.column("host_receive_t_ns"))[10:], 1e6, atol=2000)


def test_messages_that_acquisition_missed_are_fetched_by_it(
    endpoint: str, client: Client, raws: Raws, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fantwin.client.tray.ASK_AGAIN_S", 0.2)
    with acquisition(push_config(endpoint, tmp_path)):
        tray = client.tray(TRAY)
        tray.publish(T_S, [0.5, 0.5], [1.0, 1.0])
        tray.check()
        dropped: list[object] = []
        with monkeypatch.context() as lossy:
            lossy.setattr(
                tray._publisher, "_publisher", SimpleNamespace(put=lambda payload, **_: dropped.append(payload))
            )
            for number in range(1, 5):
                tray.publish(T_S + number, [0.5, 0.5], [1.0, 1.0])
            eventually(lambda: dropped and not tray._outbox.waiting, "they are sent in vain")
        losses = tray.check(10)
        assert (losses.received, losses.any) == (5, False)
        raws.wait_for(5)
    np.testing.assert_array_equal(raws.column("device_sequence"), np.arange(5))


def test_no_more_is_sent_than_can_be_asked_for_again() -> None:
    assert BY_NAME["reading"].history >= 2 * MOST_SENT_MESSAGES


def test_the_client_that_came_last_has_the_tray(endpoint: str, client: Client, raws: Raws, tmp_path: Path) -> None:
    with acquisition(push_config(endpoint, tmp_path)), fantwin.client.connect(endpoint, SITE) as other:
        first, second = client.tray(TRAY), other.tray(TRAY)
        first.publish(T_S, [0.1, 0.1], [1.0, 1.0])
        first.check()
        second.publish(T_S, [0.2, 0.2], [1.0, 1.0])
        second.check()
        first.publish(T_S + 1, [0.1, 0.1], [1.0, 1.0])
        with pytest.raises(fantwin.client.SamplesLostError, match=r"1 refused \(second_client\); two clients push"):
            first.check()
        assert first.check().refused == {"second_client": 1}, "an old loss is not raised twice"
        raws.wait_for(2)
    assert raws.column("command").tolist() == [[0.1, 0.1], [0.2, 0.2]]


def test_a_date_in_summer_time_is_the_moment_it_names() -> None:
    moment = datetime(2026, 7, 1, 14, tzinfo=UTC)
    zone = timedelta(hours=2)
    assert times_ns(moment) == times_ns(np.datetime64("2026-07-01T14:00"))
    assert times_ns([moment, moment + zone]).tolist() == [1782914400000000000, 1782921600000000000]
    assert times_ns(1.5).tolist() == [1_500_000_000]
    assert times_ns(1_790_000_000.123456) == pytest.approx(1_790_000_000_123_456_000, abs=300)


def test_a_certificate_that_may_not_publish_is_named_with_its_role(tmp_path: Path) -> None:
    site = SecuredSite(tmp_path, free_endpoint())
    site.certificates.issue("stranger")
    unknown = "the router at .* does not say what it may do; it has no such role in site 'site', or is overloaded"
    with site.running():
        for role, why in (
            ("viewer", "'viewer', which may not publish reading of a"),
            ("source.b", "'source.b', which may not publish reading of a"),
            ("stranger", f"'stranger': {unknown}"),
        ):
            site.certificates.show_as("source", role)
            security = {"folder": tmp_path}
            expected = f"tray a: .*source.pem is a certificate of role {why}; use one of role 'source', "
            with (
                fantwin.client.connect(site.endpoint, "site", mode="client", security=security) as client,
                pytest.raises(fantwin.client.NotAllowedError, match=expected),
            ):
                client.tray("a")


def test_with_certificates_a_source_publishes(endpoint: str, tmp_path: Path) -> None:
    certificates = SiteCertificates(tmp_path)
    certificates.issue("acquisition", "source", "router")
    endpoint = endpoint.replace("tcp/", "tls/")
    security = {"folder": tmp_path}
    of_peers = push_config(endpoint, tmp_path, more=f'[bus.security]\nfolder = "{tmp_path}"\n')
    config = parse_config(of_peers.text, of_peers.path, ("bus.mode='client'",))
    with pytest.raises(BusError, match='security needs mode="client"'):
        fantwin.client.connect(endpoint, SITE, security=security)
    with (
        open_router(endpoint, checked_credentials(certificates.security, ("router",)), SiteRoles.of(config)),
        acquisition(config),
        fantwin.client.connect(endpoint, SITE, mode="client", security=security) as client,
    ):
        tray = client.tray(TRAY)
        tray.publish(T_S, [0.5, 0.5], [1.0, 1.0])
        assert tray.check(10).received == 1
