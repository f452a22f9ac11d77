"""What happens to those who are not invited, or go too far: the rows of the table in docs/how-to/security.md."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from datetime import timedelta
from pathlib import Path

import numpy as np
import pytest
import zenoh

from fantwin.pipeline.bus.errors import BusError
from fantwin.pipeline.bus.session import Bus, join_bus
from fantwin.pipeline.config.loading import parse_config
from fantwin.pipeline.recordings.reading import read_recording
from fantwin.pipeline.runtime.sessions import Session
from fantwin.pipeline.timebase.host_clock import HOST_CLOCK
from fantwin.schemas.codec import decode, encode
from fantwin.schemas.enums import StageStatus
from fantwin.schemas.header import Header
from fantwin.schemas.health import Health, Output
from fantwin.schemas.messages import Grid
from fantwin.schemas.topics import BY_NAME, health_key, tray_key
from tests.support import made_messages
from tests.support.flooding_client import NOISE
from tests.support.running_chain import RunningCommand, eventually
from tests.support.secured_site import ANSWER_S, CONFIG, SITE, Heard, SecuredSite, free_endpoint, put
from tests.support.secured_stage import STEP_NS, SecuredStage, Sender, counter, samples
from tests.support.site_certificates import SiteCertificates
from tests.support.tcp_relay import TcpRelay

RAW = tray_key(SITE, "a", "raw")
FLOOD_MESSAGES, FLOOD_BYTES_AT_MOST = 14_000, 100 << 20


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Iterator[SecuredSite]:
    with SecuredSite(tmp_path_factory.mktemp("site"), free_endpoint()).running() as running:
        yield running


def client(endpoint: str, **files: str) -> zenoh.Session:
    """A program with Zenoh, and with these files for TLS."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", f'["{endpoint}"]')
    config.insert_json5("connect/timeout_ms", "1000")
    config.insert_json5("scouting/multicast/enabled", "false")
    for name, path in files.items():
        config.insert_json5(f"transport/link/tls/{name}", f'"{path}"')
    return zenoh.open(config)


def files_of(certificates: SiteCertificates, role: str, ca: Path | None = None) -> dict[str, str]:
    folder = certificates.folder
    return {
        "root_ca_certificate": str(ca or folder / "ca.pem"),
        "connect_certificate": str(folder / f"{role}.pem"),
        "connect_private_key": str(folder / f"{role}.key"),
    }


def test_rows_1_to_4_without_a_valid_certificate_of_the_site_nobody_connects_nor_to_a_router_of_another_one(
    site, tmp_path
):
    """Who takes the place of the router sees nothing of what stages would send."""
    of_ours = site.certificates.folder / "ca.pem"
    theirs = SecuredSite(tmp_path / "theirs", free_endpoint())
    expired = SiteCertificates(tmp_path / "expired", site.certificates.authority)
    expired.issue("acquisition", lifetime=-timedelta(minutes=1))
    with theirs.running():
        for endpoint, files in (
            (site.endpoint.replace("tls/", "tcp/"), {}),
            (site.endpoint, {"root_ca_certificate": str(of_ours)}),
            (site.endpoint, files_of(theirs.certificates, "acquisition", of_ours)),
            (site.endpoint, files_of(expired, "acquisition")),
            (theirs.endpoint, files_of(site.certificates, "scorer")),
        ):
            with pytest.raises(zenoh.ZError):
                client(endpoint, **files)


def test_row_6_a_huge_message_is_refused_by_who_receives_it_and_counted(site):
    received: list[bytes] = []
    arrived = threading.Event()
    key = tray_key(SITE, "a", "command")
    with join_bus(site.config, roles=("acquisition",)) as bus:

        def take(_key: str, payload: bytes) -> None:
            received.append(payload)
            arrived.set()

        bus.subscribe(key, take)
        bus.require_rights()
        site.flush("operator")
        put(site.session("operator"), key, bytes(BY_NAME["command"].largest_bytes + 1))
        put(site.session("operator"), key, b"small")
        assert arrived.wait(30)
        assert (received, bus.refused_too_large) == ([b"small"], 1)


def test_row_7_nonsense_on_the_port_does_not_disturb_those_who_are_connected(site):
    host, port = site.endpoint.removeprefix("tls/").split(":")
    heard = Heard(site.session("resampler"), RAW)
    site.flush("resampler")
    strangers = [socket.create_connection((host, int(port)), 5) for _ in range(50)]
    for number, stranger in enumerate(strangers):
        stranger.sendall(bytes([number]) * 1000)
    put(site.session("acquisition"), RAW, b"sample")
    put(site.session("acquisition"), RAW, b"sentinel")
    assert heard.until_sentinel() == [(RAW, b"sample")]
    for stranger in strangers:
        stranger.close()


def test_rows_8_and_9_a_stage_with_another_role_or_one_that_the_router_does_not_know_is_refused_in_one_line(site):
    """Unknown is a tray that the configuration of the router does not have yet."""
    with join_bus(site.config, roles=("resampler",)) as bus:
        bus.publisher(RAW, BY_NAME["raw"], "x", "me")
        with pytest.raises(BusError) as refused:
            bus.require_rights()
    assert str(refused.value).startswith("its certificate says 'resampler', which may not publish raw of a")
    assert "\n" not in str(refused.value)
    with Bus(site.config.bus, roles=("viewer",)) as bus:
        bus.publisher(RAW, BY_NAME["raw"], "x", "me")
        bus.require_rights()  # without the roles of its site it is held to none
    text = CONFIG.format(endpoint=site.endpoint).replace('name = "b"', 'name = "c"')
    newer = parse_config(text, site.config.path, stages=())
    site.certificates.issue("acquisition.c")
    with join_bus(newer, roles=("acquisition.c",)) as bus:
        bus.publisher(tray_key(SITE, "c", "raw"), BY_NAME["raw"], "x", "me")
        with pytest.raises(BusError, match="the router refuses all of role 'acquisition.c': restart it"):
            bus.require_rights()


def test_row_11_peers_refuse_one_another_what_a_router_would(tmp_path):
    """Peers without a router have the rules themselves."""
    site = SecuredSite(tmp_path, free_endpoint())
    text = site.config.text.replace('mode = "client"', 'mode = "peer"')
    config = parse_config(text, site.config.path, stages=())
    heard: list[bytes] = []
    arrived = threading.Event()
    with (
        join_bus(config, roles=("resampler",)) as resampler,
        join_bus(config, roles=("acquisition",)) as acquisition,
        join_bus(config, roles=("viewer",)) as viewer,
    ):

        def take(_key: str, payload: bytes) -> None:
            heard.append(payload)
            arrived.set()

        resampler.subscribe(RAW, take)
        for bus in (acquisition, viewer):
            bus.wait_for_others(threading.Event())
        forging, sending = (bus.publisher(RAW, BY_NAME["raw"], "x", "me") for bus in (viewer, acquisition))
        for _ in range(600):
            forging.put(b"forged")
            sending.put(b"sample")
            if arrived.wait(0.05):
                break
        with pytest.raises(BusError, match="may not publish raw of a"):
            viewer.require_rights()
    assert set(heard) == {b"sample"}


def test_row_12_recorded_messages_that_are_sent_again_are_not_taken_again(site):
    """By whoever may not publish them they reach nobody. By whoever may: those of a session that a stage knows are
    duplicates, and those of one from before it started are of a stranger."""
    operator = join_bus(site.config, roles=("operator",))
    grids: list[Grid] = []
    operator.subscribe(tray_key(SITE, "a", "grid"), lambda _key, payload: grids.append(decode(Grid, payload)))
    with join_bus(site.config, roles=("acquisition",)) as bus:
        before = Sender(bus, "before")
        for _ in range(3):
            before.send()
    with (
        operator,
        SecuredStage(site, "resampler", "resampler.rate_hz=100") as stage,
        join_bus(site.config, roles=("acquisition",)) as bus,
    ):
        sender = Sender(bus, "now")
        for _ in range(5):
            sender.send()
        sender.send_health()
        stage.health_with(lambda health: has_received(health, sender, 5), "all has arrived")
        recorded = [*before.sent, *sender.sent]
        for role in ("viewer", "resampler", "acquisition.b", "acquisition"):
            for payload in recorded:
                put(site.session(role), RAW, payload)
            site.flush(role)
        sender.send()
        health = stage.health_with(lambda health: has_received(health, sender, 6), "the next one has arrived")
        assert sum(line.duplicated for line in health.inputs) == len(sender.sent) - 1
        assert counter(health, "refused_producers") == len(before.sent)
        assert "acquisition-all-before is not a stage of this site" in health.problem
        newest_ns = sender.newest_ns
        eventually(lambda: grids and grids[-1].t_ns[-1] >= newest_ns - STEP_NS, "the grid of all samples is there")
    t_ns = np.concatenate([grid.t_ns for grid in grids])
    valid = np.concatenate([grid.valid for grid in grids])
    assert (np.diff(t_ns) == STEP_NS).all() and valid.all(), "each time once, and no sample of another session"


def has_received(health: Health, sender: Sender, number: int) -> bool:
    return any(line.producer == sender.producer and line.received >= number for line in health.inputs)


def test_row_13_a_flood_holds_nobody_up_and_fills_no_memory(tmp_path):
    """A viewer floods the topic of healthy samples, where it may not; the owner of tray b's certificate its own topic,
    which the same stage reads. The samples of tray a arrive, in order and without loss. All are processes of their own:
    within one, sessions share threads of Zenoh."""
    site = SecuredSite(tmp_path, free_endpoint())
    site.config.path.write_text(site.config.text)
    router = RunningCommand(["router", "-c", site.config.path])
    try:
        run_row_13(site, router.process.pid)
    finally:
        router.kill()


def run_row_13(site: SecuredSite, router_id: int) -> None:
    with (
        SecuredStage(site, "resampler") as stage,
        join_bus(site.config, roles=("acquisition",)) as bus,
        flooding(site, "viewer", RAW) as refused,
        flooding(site, "acquisition.b", tray_key(SITE, "b", "raw")) as taken,
    ):
        sender = Sender(bus, "healthy")
        before = [resident_bytes(process_id) for process_id in (router_id, os.getpid())]
        eventually(lambda: counter(stage.newest, "undecodable"), "the flood has begun")
        for number in (1, 2):
            began = counter(stage.newest, "undecodable")
            sender.send()
            health = stage.health_with(lambda health, number=number: has_received(health, sender, number), "it arrives")
            assert counter(health, "undecodable") > began, "the flood goes on meanwhile"
        sent = [int(each.communicate()[0]) for each in (refused, taken)]
        health = stage.health_with(lambda health: counter(health, "undecodable") == sent[1], "all is counted")
        after = [resident_bytes(process_id) for process_id in (router_id, os.getpid())]
        grown = [now - earlier for now, earlier in zip(after, before, strict=True)]
        assert max(grown) < FLOOD_BYTES_AT_MOST < len(NOISE) * min(sent), grown
    assert health.lost == 0
    assert [(line.received, line.missing) for line in health.inputs] == [(2, 0)]


def resident_bytes(process_id: int) -> int:
    return int(Path(f"/proc/{process_id}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


@contextmanager
def flooding(site: SecuredSite, role: str, key: str) -> Iterator[subprocess.Popen[str]]:
    files = [str(site.certificates.folder), site.endpoint]
    words = [sys.executable, "-m", "tests.support.flooding_client", *files, role, key, str(FLOOD_MESSAGES)]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


@pytest.mark.parametrize("name", ["resampler", "recorder"])
def test_row_14_malformed_messages_are_counted_and_stop_nobody(site, tmp_path, name):
    """Noise, parts of messages, and messages with changed bytes, on each topic of a tray that the stage reads."""
    random = np.random.default_rng(1)
    good = encode(replace(samples(0, 0), header=Header("x", 0, "b")))
    noise = [b"\xff" * size for size in (1, 10, 1000)]
    parts = [good[:size] for size in range(1, len(good), 40)]
    changed = [bytearray(good) for _ in range(100)]
    for each in changed:
        each[int(random.integers(len(each)))] = int(random.integers(256))
    with (
        SecuredStage(site, name, f"run_folder='{tmp_path}'") as stage,
        join_bus(site.config, roles=("acquisition",)) as bus,
    ):
        for payload in (*noise, *parts, *changed):
            put(site.session("acquisition"), tray_key(SITE, "b", "raw"), bytes(payload))
        put(site.session("acquisition"), health_key(SITE, "acquisition", "all"), noise[1])
        site.flush("acquisition")
        health = stage.health_with(lambda health: counter(health, "undecodable") > len(noise), "noise has been counted")
        assert health.status != StageStatus.STOPPED
        sender = Sender(bus, "healthy")
        sender.send()
        stage.health_with(lambda health: has_received(health, sender, 1), "a good message arrives")
    if name == "recorder":
        (recording,) = tmp_path.glob("*.mcap")
        reading = read_recording(recording)
        assert any(envelope.header.tray == "a" for envelope in reading)
        assert reading.damage == ""


def test_a_router_that_cannot_answer_because_the_link_is_cut_refuses_nothing(site):
    """The questions of a stage end without an answer, as at a router that does not know its role."""
    with closing(TcpRelay(site.endpoint.replace("tls/", "tcp/"))) as relay:
        through = site.config.bus.model_copy(update={"endpoint": relay.endpoint.replace("tcp/", "tls/")})
        with join_bus(replace(site.config, bus=through), threading.Event(), roles=("acquisition",)) as bus:
            bus.publisher(RAW, BY_NAME["raw"], "x", "me")
            bus.require_rights()
            relay.cut()
            bus.require_rights()


def test_rows_15_to_17_what_a_health_claims_a_token_names_and_a_header_says_beyond_its_role_is_not_believed(site):
    """A claim to have published would make each message of others one of a stranger, and what was never sent a loss; a
    viewer may write any producer into its tokens; the rules see the key, and a core is chosen by the header's tray."""
    claims = (("viewer", "viewer", "evil"), ("acquisition.b", "acquisition", "b"))
    tokens: list[zenoh.LivelinessToken] = []
    with (
        SecuredStage(site, "resampler") as stage,
        join_bus(site.config, roles=("acquisition",)) as bus,
    ):
        for number, (role, name, instance) in enumerate(claims, start=1):
            producer = f"{name}-{instance}-1"
            outputs = (Output(key=RAW, published=4000),)
            claim = made_messages.health(name, instance, producer, t_ns=HOST_CLOCK.now_ns(), outputs=outputs)
            thief, shown = site.session(role), Session(name, instance, 1, producer, "host", 2, ())
            tokens.append(thief.liveliness().declare_token(shown.key(SITE)))
            put(thief, health_key(SITE, name, instance), encode(claim))
            site.flush(role)
            stage.health_with(lambda health, n=number: counter(health, "refused_outputs") == n, "the claim was seen")
        sender = Sender(bus, "healthy")
        sender.send()
        sender.send_health()
        stage.health_with(lambda health: has_received(health, sender, 1), "samples of others arrive")

        forged = Session("viewer", "all", 1, sender.producer, "host", 2)
        later = Session("viewer", "all", 2, "viewer-all-1", "host", 2)
        viewer = site.session("viewer").liveliness()
        tokens += [viewer.declare_token(session.key(SITE)) for session in (forged, later)]
        site.flush("viewer")
        shown_tokens = site.session("router").liveliness().get(forged.key(SITE), timeout=ANSWER_S)
        assert any(reply.ok for reply in shown_tokens), "the rules let it show them"
        sender.send()
        stage.health_with(lambda health: has_received(health, sender, 2), "the next sample has arrived")
        for token in tokens:
            token.undeclare()
        sender.send()
        stage.health_with(lambda health: has_received(health, sender, 3), "and the one after it")

        grids = Heard(site.session("twin_integrator"), tray_key(SITE, "b", "grid"))
        site.flush("twin_integrator")
        for number in range(30):
            other_tray = replace(samples(0, number), header=Header("acquisition-a-1", number, "b"))
            put(site.session("acquisition.a"), RAW, encode(other_tray))
        site.flush("acquisition.a")
        health = stage.health_with(lambda health: counter(health, "refused_of_other_key") == 30, "all are counted")
        assert [line.producer for line in health.inputs] == [sender.producer]
        assert (counter(health, "refused_producers"), counter(health, "refused_forged"), health.lost) == (0, 0, 0)
    assert grids.messages == []
