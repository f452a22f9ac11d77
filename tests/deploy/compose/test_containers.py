"""compose.yaml brought up for real, killed, cut off and stopped: `make compose-test`.

The tests are steps of one run, in this order.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from pipeline.config.registry import STAGES
from tests.support import compose_site as site
from tests.support.fantwin_command import fantwin

FOLDER = site.folder()
pytestmark = pytest.mark.skipif(FOLDER is None, reason="containers: `make compose-test` brings compose.yaml up")
ENABLED = [name for name, row in STAGES.items() if row.enabled_by == "default"]
FAULT = "--fault inlet:fan=2,start=3,size=1.8"
CUT_S = 3.0
WITHIN_S = 40.0


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
    seen, took_s = site.well_again(60.0)
    print(f"well after {took_s:.1f} s")
    assert {each["stage"] for each in seen["stages"]} == set(ENABLED)
    assert not site.losses(seen)
    assert not seen["alarms"]


@pytest.mark.parametrize("service", ["router", *ENABLED])
def test_a_service_whose_process_is_killed_comes_back(service: str):
    site.kill(service)

    def is_new(seen: site.Status) -> bool:
        return all(each["uptime_s"] < WITHIN_S for each in seen["stages"] if each["stage"] == service)

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


@pytest.mark.parametrize("service", ["acquisition", "scorer", "recorder"])
def test_a_service_that_is_cut_off_joins_again(service: str):
    site.cut_off(service, CUT_S)
    seen, took_s = site.well_again(WITHIN_S, has_alarm)
    print(f"{service}: well again {took_s:.1f} s after a cut of {CUT_S:g} s; lost so far: {site.losses(seen)}")
    assert set(site.losses(seen)) <= {"resampler"}


def test_the_whole_recording_comes_out_of_the_volume(tmp_path: Path):
    for service in [*ENABLED, "router"]:  # as `docker compose stop` does it: podman-compose 1.6 stops all at once
        site.compose("stop", service)
    site.succeed("podman", "cp", f"{site.container('recorder')}:/runs/.", str(tmp_path))
    kept = sorted(path.name for path in tmp_path.iterdir())
    print(kept)
    assert "scorer-tray1.snapshot" in kept
    assert not list(tmp_path.glob("*.active")), "every part is closed"
    info = fantwin("info", tmp_path)
    print(info.stdout)
    verified = fantwin("replay", "--offline", "--verify", tmp_path)
    print(verified.stdout)
    assert "equal: " in verified.stdout
    assert "1 alarm in" in verified.stdout, "it was raised once, whatever was killed"
    shutil.rmtree(tmp_path)
