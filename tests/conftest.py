"""Fixtures that several test modules share."""

from __future__ import annotations

import gc
import os
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from tests.support.made_once import MadeOnce, TrainedOnce
from tests.support.ports import free_port
from tests.support.site_users import quick_hasher
from tests.support.small_disk import mount, unmount

# The same examples on every run, and no judgement of how long one takes: machines differ.
settings.register_profile("house", derandomize=True, deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("house")

# Quiet hours and times in messages are those of the host, and hosts differ.
os.environ["TZ"] = "UTC"
time.tzset()


def pytest_collectstart() -> None:
    """Look for no garbage among what is being imported: it is half a million objects, and stays."""
    gc.disable()


def pytest_collection_finish() -> None:
    """Look for it again, but not among those."""
    gc.freeze()
    gc.enable()


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Spread the tests in real time over the share of each worker, between the modules of the others: they wait more
    than they work, so the others use the cores meanwhile. The last part of a share is without them, and evens out when
    the workers end."""
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "0"))
    if not workers:
        return
    in_real_time = [item for item in items if item.get_closest_marker("real_time")]
    others = [item for item in items if not item.get_closest_marker("real_time")]
    shares = [others[len(others) * k // workers : len(others) * (k + 1) // workers] for k in range(workers)]
    items[:] = [item for k, share in enumerate(shares) for item in _mixed(in_real_time[k::workers], share)]


def _mixed(in_real_time: list[pytest.Item], others: list[pytest.Item]) -> list[pytest.Item]:
    """Both, the first kind spread over the first two thirds of the other, whose modules stay whole."""
    mixed: list[pytest.Item] = []
    waiting = list(in_real_time)
    for number, item in enumerate(others):
        is_first_of_module = not number or item.path != others[number - 1].path
        due = len(in_real_time) - len(waiting)
        if waiting and is_first_of_module and 3 * number * len(in_real_time) >= 2 * due * len(others):
            mixed.append(waiting.pop(0))
        mixed.append(item)
    return mixed + waiting


@pytest.fixture(scope="session", autouse=True)
def _without_power_cuts() -> Iterator[None]:
    """A process reads what it has written without a flush to the disk, which would take half of the time of the tests
    that write much. Tests of the flush itself put their own in its place."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda _descriptor: None)
        patch.setattr(os, "fdatasync", lambda _descriptor: None)
        yield


@pytest.fixture(scope="session", autouse=True)
def _one_process_for_each_command() -> Iterator[None]:
    """A command works in the process of its test unless it is given --jobs: the tests themselves share the cores, and
    the start of a worker costs more than the work on a short recording."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LOKY_MAX_CPU_COUNT", "1")
        yield


@pytest.fixture
def endpoint() -> str:
    """A bus endpoint on loopback that nothing else uses."""
    return f"tcp/127.0.0.1:{free_port()}"


@pytest.fixture(scope="session")
def made_once(tmp_path_factory: pytest.TempPathFactory) -> MadeOnce:
    own = tmp_path_factory.getbasetemp()
    place = (own.parent if "PYTEST_XDIST_WORKER" in os.environ else own) / "made-once"
    place.mkdir(exist_ok=True)
    return MadeOnce(place)


@pytest.fixture(scope="session")
def trained_once(made_once: MadeOnce) -> TrainedOnce:
    return TrainedOnce(made_once)


@pytest.fixture(scope="module")
def quickly_hashed() -> Iterator[None]:
    """A hash of a password takes 64 MB and a tenth of a second, which the tests that ask for this do not look at."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("fantwin.pipeline.site.users.hasher", quick_hasher)
        yield


@pytest.fixture
def never_silent(monkeypatch: pytest.MonkeyPatch) -> None:
    """What was fed is the state of now, whatever time passes."""
    monkeypatch.setattr("fantwin.pipeline.site.site_model.SILENT_AFTER_S", 1e9)


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """The folder of a separate disk of a few MB; skips the test where none can be mounted."""
    place = tmp_path / "disk"
    place.mkdir()
    if not mount(place):
        pytest.skip("no file system can be mounted here")
    try:
        yield place
    finally:
        unmount(place)


@pytest.fixture(scope="session")
def measured_data() -> Path:
    """The folder of the measured data sets; skips the test where it is missing."""
    folder = Path(os.environ.get("FANTWIN_DATA", Path(__file__).parents[2] / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no measured data at {folder}; set FANTWIN_DATA, see docs/how-to/datasets.md")
    return folder
