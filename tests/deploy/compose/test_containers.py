"""compose.yaml brought up for real, killed, cut off and stopped: `make compose-test`.

The tests are steps of one run, in this order.
"""

from __future__ import annotations

import json
import shutil
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest

from fantwin.pipeline.config.loading import load_config
from tests.support import compose_site as site
from tests.support.fantwin_command import fantwin

FOLDER = site.folder()
pytestmark = pytest.mark.skipif(FOLDER is None, reason="containers: `make compose-test` brings compose.yaml up")
ENABLED = load_config(Path(__file__).parents[3] / "deploy/compose/site/fantwin.toml").stages
FAULT = "--fault inlet:fan=2,start=3,size=1.8"
OWN_CERTIFICATES = """cd /tmp
cat > own.toml <<END
site = "demo"
[bus]
mode = "client"
endpoint = "tls/router:7447"
[bus.security]
[[tray]]
name = "tray1"
fans = 8
port = "/tmp/tray"
speed_max = 20000
END
fantwin certs init -c own.toml >/dev/null
fantwin certs issue -c own.toml >/dev/null
"""
CUT_S = 3.0
WITHIN_S = 120.0


@pytest.fixture(scope="module", autouse=True)
def up() -> Iterator[None]:
    """The site, built and started; it has gone afterwards, with its volumes."""
    assert FOLDER is not None
    site.build(FOLDER / "wheels", FOLDER / "pip.conf", FOLDER / "base.tar")
    site.compose("up", "-d", "--no-build")
    try:
        yield
    finally:
        site.compose("down", "-v")


def the_alarm(seen: site.Status) -> dict[str, object]:
    (alarm,) = [each for each in seen["alarms"] if each["active"]]
    return alarm


def has_alarm(seen: site.Status) -> bool:
    return any(each["active"] for each in seen["alarms"])


def test_all_is_well_without_losses():
    seen, took_s = site.well_again(WITHIN_S)
    print(f"well after {took_s:.1f} s")
    assert {each["stage"] for each in seen["stages"]} == set(ENABLED)
    assert not site.losses(seen)
    assert not seen["alarms"]


def test_the_image_is_small_has_no_rerun_and_says_whether_it_is_healthy():
    size = int(site.succeed("podman", "image", "inspect", "-f", "{{.Size}}", "fantwin"))
    base = int(site.succeed("podman", "image", "inspect", "-f", "{{.Size}}", site.BASE_IMAGE))
    print(f"image: {(size - base) / 1e6:.0f} MB on top of its base")
    assert size - base < 600e6
    assert site.run("podman", "exec", site.container("gateway"), "python", "-c", "import rerun").returncode
    for service in ("router", *ENABLED):
        site.succeed("podman", "healthcheck", "run", site.container(service))


def test_the_page_is_at_the_published_port_and_prometheus_scrapes_it():
    with urllib.request.urlopen("http://127.0.0.1:8080/api/v1/site", timeout=10) as answer:
        assert json.load(answer)["site"] == "demo"
    site.prometheus_from(shutil.which("prometheus"))
    site.compose("--profile", "metrics", "up", "-d", "--no-build", "--no-deps", "prometheus")
    query = "http://127.0.0.1:9090/api/v1/query?query=fantwin_fan_scored"
    ask = ("python", "-c", f"import urllib.request as r; print(r.urlopen('{query}').read().decode())")

    def has_fans() -> bool:
        done = site.run("podman", "exec", site.container("gateway"), *ask)
        return done.returncode == 0 and len(json.loads(done.stdout)["data"]["result"]) == 8

    site.wait_until(has_fans, WITHIN_S, "Prometheus has no fans")


@pytest.mark.parametrize("service", ["router", *ENABLED])
def test_a_container_has_its_own_key_only(service: str):
    seen = site.succeed("podman", "exec", site.container(service), "find", "/certs", "/authority", "-name", "*.*")
    roles = (service, "viewer") if service == "gateway" else (service,)
    assert {*seen.split()} == {"/certs/ca.pem", *(f"/certs/{role}.{kind}" for role in roles for kind in ("pem", "key"))}


def test_fantwin_without_the_certificates_of_the_site_cannot_join():
    without = site.in_new_container(f"exec fantwin status -c {site.CONFIG}")
    foreign = site.in_new_container(OWN_CERTIFICATES + "exec fantwin status -c own.toml")
    for each in (without, foreign):
        print(each.stderr.strip())
        assert (each.returncode, each.stdout) == (1, "")


@pytest.mark.parametrize("service", ["router", *ENABLED])
def test_a_service_whose_process_is_killed_comes_back(service: str):
    killed_s = time.monotonic()
    site.kill(service)

    def is_new(seen: site.Status) -> bool:
        age_s = time.monotonic() - killed_s
        return all(each["uptime_s"] < age_s for each in seen["stages"] if each["stage"] == service)

    seen, took_s = site.well_again(WITHIN_S, is_new)
    print(f"{service}: well again after {took_s:.1f} s; lost so far: {site.losses(seen)}")
    assert set(site.losses(seen)) <= {"resampler"}, "what came too late for the grid, and nothing else"
    assert not seen["alarms"]


def test_a_fault_of_a_fan_raises_an_alarm():
    site.compose("up", "-d", "--no-build", "--no-deps", "acquisition", SIMULATE_OPTIONS=FAULT)
    seen, took_s = site.well_again(WITHIN_S, has_alarm)
    print(f"alarm seen after {took_s:.1f} s")
    assert the_alarm(seen)["fan"] == 2


def test_a_scorer_that_is_killed_goes_on_with_its_alarm():
    before = the_alarm(site.status())
    site.kill("scorer")
    seen, took_s = site.well_again(WITHIN_S, has_alarm)
    print(f"scorer: well again after {took_s:.1f} s")
    assert the_alarm(seen)["onset_t_ns"] == before["onset_t_ns"]


def test_an_operator_may_act_and_a_viewer_may_not():
    words = ("alarms", "acknowledge", "tray1", "2", "-c", site.CONFIG)
    refused = site.fantwin(*words)
    print(refused.stderr.strip())
    assert refused.returncode == 1
    assert not the_alarm(site.status())["acknowledged"]
    site.compose("--profile", "operator", "run", "--rm", "-T", "operator", *words)
    assert the_alarm(site.status())["acknowledged"]


def test_certificates_are_renewed_and_used_after_a_restart():
    read = ("podman", "exec", site.container("twin_integrator"), "cat", "/certs/twin_integrator.pem")
    before = site.succeed(*read)
    site.compose("run", "--rm", "-T", "certs", "renew")
    assert site.succeed(*read) != before
    site.kill("twin_integrator")
    _, took_s = site.well_again(WITHIN_S)
    print(f"well again with a new certificate after {took_s:.1f} s")


@pytest.mark.parametrize("service", ["acquisition", "scorer", "recorder"])
def test_a_service_that_is_cut_off_joins_again(service: str):
    site.cut_off(service, CUT_S)
    seen, took_s = site.well_again(WITHIN_S, has_alarm)
    print(f"{service}: well again {took_s:.1f} s after a cut of {CUT_S:g} s; lost so far: {site.losses(seen)}")
    assert set(site.losses(seen)) <= {"resampler"}


@pytest.mark.timeout(600)  # most of it is the replay, on machines with much else to do
def test_the_whole_recording_comes_out_of_the_volume(tmp_path: Path):
    for service in [*ENABLED, "router"]:  # as `docker compose stop` does it: podman-compose 1.6 stops all at once
        site.compose("stop", service)
    site.succeed("podman", "cp", f"{site.container('recorder')}:/runs/.", str(tmp_path))
    kept = sorted(path.name for path in tmp_path.iterdir())
    print(kept)
    assert "scorer-tray1.snapshot" in kept
    assert not list(tmp_path.glob("*.active")), "every part is closed"
    print(fantwin("info", tmp_path).stdout)
    info = json.loads(fantwin("info", "--json", tmp_path).stdout)
    missing = {topic: counts["missing"] for topic, counts in info["topics"].items() if counts["missing"]}
    assert not missing, "what a recorder has missed it asks for"
    assert not info["continuity"], "the parts follow one another"
    verified = fantwin("replay", "--offline", "--verify", "--jobs", 1, tmp_path)
    print(verified.stdout)
    assert "equal: " in verified.stdout
    assert "1 alarm in" in verified.stdout, "it was raised once, whatever was killed"
    shutil.rmtree(tmp_path)
