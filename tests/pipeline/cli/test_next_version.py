"""Learned versions from real training: the first, better limits with more data, and what fans that have changed get."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.learning import drops_found, next_version
from fantwin.pipeline.learning.fitting import TrainingSettings, fit_twin
from fantwin.pipeline.learning.healthy_history import healthy_recordings
from fantwin.pipeline.learning.history_recordings import HistoryRecording
from fantwin.pipeline.learning.next_version import make_next_version
from fantwin.pipeline.learning.version_data import newest_recordings
from fantwin.pipeline.learning.versions import TwinVersions, Version
from fantwin.pipeline.prediction.tray_twin import load_tray_twin
from fantwin.pipeline.replay.offline.calibration_of_twin import calibration_in
from fantwin.schemas.units import NS_PER_S
from fantwin.twin.export.onnx_export import with_card_entries
from tests.support.fantwin_command import error_of, fantwin
from tests.support.healthy_recordings import FANS, START_S, add_recording
from tests.support.made_once import MadeOnce

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module", autouse=True)
def _in_minutes() -> Iterator[None]:
    """What a site does in hours, with twins that are trained at once: what is chosen and why is the same."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("fantwin.pipeline.learning.versions.REFERENCE_S", 110.0)
        patch.setattr(next_version, "CHECKED_S", 100.0)
        patch.setattr(next_version, "LEAST_CHECKED_S", 60.0)
        patch.setattr(drops_found, "WITHIN_S", (1.0, 10.0, 60.0))  # drops of two versions are compared
        patch.setattr(next_version, "fit_twin", partial(fit_twin, settings=TrainingSettings("physical")))
        yield


def made(folder: Path, *, only_if_changed: bool = False) -> Version | None:
    return make_next_version(folder, "tray1", 1.0, lambda _line: None, only_if_changed=only_if_changed)


@pytest.fixture(scope="module")
def two_versions(made_once: MadeOnce) -> Path:
    """The learning folder of a tray with two versions."""

    def make(folder: Path) -> None:
        for first_s, seconds, seed in ((0, 62.0, 1), (1000, 70.0, 2)):
            add_recording(folder, first_s, seconds, seed)
            assert made(folder)

    return made_once("two-versions", make)


@pytest.fixture
def site(two_versions: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy, whose further versions get the limits of the second one: what they are made of is not their limits."""
    second = two_versions / "tray1-2.onnx"
    calibration, drops = (
        calibration_in(second, load_tray_twin(second)),
        TwinVersions(two_versions, "tray1").all()[1].drops,
    )
    assert calibration

    def calibrated(work: next_version._Work, twin: Path, _test: object) -> next_version._CalibratedFile:
        named = with_card_entries(twin.read_bytes(), {"name": work._name})
        return next_version._CalibratedFile(named, calibration, drops)

    monkeypatch.setattr(next_version._Work, "_calibrated", calibrated)
    return shutil.copytree(two_versions, tmp_path / "runs" / "learned" / "tray1")


def test_near_alarms_only_a_change_of_all_fans_is_offered(site: Path) -> None:
    add_recording(site, 2000, 120.0, 5, (0.7, 1.0), has_alarm=True)
    assert made(site, only_if_changed=True) is None
    check = TwinVersions(site, "tray1").read().check
    assert check
    assert check.found == ""
    assert check.near_t_ns / NS_PER_S > START_S + 2100, "or it would be made again at once"
    for first_s in (3000, 3100, 3200):
        add_recording(site, first_s, 70.0, 6, (1.06, 1.05), has_alarm=True)
    offered = made(site, only_if_changed=True)
    assert offered
    assert offered.outcome == "offered"
    assert offered.why.startswith("all fans are ")
    assert "it was learned from running near alarms too" in offered.why
    assert offered.learned_spans[0][0] / NS_PER_S == pytest.approx(START_S + 3100, abs=1.0), "that of the newest hours"
    assert offered.error_before
    assert offered.error < 0.5 * offered.error_before
    in_force = TwinVersions(site, "tray1").in_force()
    assert in_force
    assert in_force.name == "tray1-2"
    again = made(site, only_if_changed=True)
    assert again is None, "it is offered already"


def test_no_first_twin_is_learned_of_tachos_that_are_not_declared(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its fans would seem to be slow, and no alarm would come where they turn slowly."""
    add_recording(tmp_path, 0, 120.0, 1)
    monkeypatch.setattr(next_version, "tacho_hints", lambda *_arguments: ["fan 0: a count over 1 s"])
    with pytest.raises(UserError, match="fan 0: a count over 1 s: declare the tacho .* delete .*healthy, whose"):
        made(tmp_path)
    assert not TwinVersions(tmp_path, "tray1").all()


def test_the_first_version_is_a_target_only_and_the_next_is_from_more_healthy_running(two_versions: Path) -> None:
    first, second = TwinVersions(two_versions, "tray1").all()
    assert (first.name, first.how, first.outcome, first.reference) == ("tray1-1", "trained", "taken", "tray1-1")
    assert first.is_target
    twin = load_tray_twin(two_versions / "tray1-1.onnx", FANS)
    assert (twin.card.name, twin.sha256) == ("tray1-1", first.sha256)
    assert twin.card.calibration
    assert first.error < 10.0, "rad/s; the noise is sqrt(10)"
    assert second.outcome == "taken"
    assert second.hours > 2.0 * first.hours
    within = [[drop.within_60_s for drop in each.drops] for each in (first, second)]
    assert all(drop for drops in within for drop in drops)
    assert sum(drop or 0.0 for drop in within[1]) <= sum(drop or 0.0 for drop in within[0])
    assert load_tray_twin(two_versions / "tray1-2.onnx", FANS).card.name == "tray1-2"
    assert not list(two_versions.glob("learning-*")), "the working folder is gone"


def test_what_is_made_of_fans_as_they_change_and_how_it_is_listed_and_put_in_force(site: Path) -> None:
    versions = TwinVersions(site, "tray1")
    before = versions.all()
    assert made(site, only_if_changed=True) is None
    assert versions.all() == before, "fans that have not changed pass the check"
    check = versions.read().check
    assert check and check.reference == "tray1-2"
    assert check.change == pytest.approx((0.0, 0.0), abs=0.01)

    add_recording(site, 2000, 120.0, 3, (1.06, 1.05))
    third = made(site, only_if_changed=True)
    assert third and third.outcome == "offered"
    assert third.why.startswith("all fans are ")
    assert "% faster than when tray1-2 was made; if maintenance, a filter or new firmware" in third.why
    in_force = versions.in_force()
    assert in_force and in_force.name == "tray1-2", "nothing is taken"
    assert third.change[0] == pytest.approx(0.0, abs=0.02), "an offered version is its own reference"
    assert third.error_before
    assert third.error < 0.5 * third.error_before, "it fits the fans as they are now"

    add_recording(site, 3000, 120.0, 4, (1.0, 0.92))
    fourth = made(site)
    assert fourth and fourth.outcome == "offered"
    assert fourth.why.startswith("fan 1 is ")
    assert "% slower than when tray1-2 was made; inspect it: if it is healthy, put this version in force" in fourth.why
    learned = [each.span for each in healthy_recordings(site, versions.read().excluded_spans)]
    assert len(learned) == 2, "the two before the fans changed"

    config = site.parents[2] / "fantwin.toml"
    config.write_text('run_folder = "runs"\n[[tray]]\nname = "tray1"\nfans = 2\n', encoding="utf-8")
    listed = fantwin("twins", "-c", config).stdout
    assert "tray1-2: IN FORCE: " in listed
    assert "tray1-3: was offered: trained; limits from 0.0333 h" in listed
    assert "tray1-4: offered: trained; limits from 0.0333 h" in listed
    beside = [line.split() for line in listed.splitlines() if line.startswith("  error over the newest recording")]
    (words,) = beside
    assert float(words[5]) > 2.0 * float(words[7]), "of the version in force, and of the one that is offered"
    assert "checked up to 2027-01-15" in listed
    assert fantwin("twins", "-c", config, "use", "tray1-3").exit_code == 0
    assert json.loads(fantwin("twins", "-c", config, "--json").stdout)["in_force"] == "tray1-3"
    assert "no version 'tray1-9'; there are tray1-1, tray1-2" in error_of("twins", "-c", config, "use", "tray1-9")
    fantwin("twins", "-c", config, "use", "tray1-2")
    day = ("faulty", "2027-01-14", "2027-01-17")
    said = fantwin("twins", "-c", config, *day).stdout
    assert "tray1-2 was learned from that time span and stays in force: no version can replace it; the next" in said
    assert "marked as faulty: 2027-01-14" in said


def test_a_tray_that_has_learned_nothing_yet_says_what_makes_its_first_twin(tmp_path: Path) -> None:
    config = tmp_path / "fantwin.toml"
    config.write_text('[[tray]]\nname = "tray1"\nfans = 2\n', encoding="utf-8")
    assert "tray1 has no twin yet: `fantwin up` makes the first" in fantwin("twins", "-c", config).stdout


def test_limits_are_from_as_many_of_the_newest_recordings_as_are_wanted_and_not_from_fewer() -> None:
    hours = [8, 8, 8, 8, 3]
    history = [HistoryRecording(Path(f"{k}.mcap"), (k, k + hours[k] * 3600 * NS_PER_S)) for k in range(len(hours))]
    assert newest_recordings(history, 24 * 3600.0) == history[1:]
    assert newest_recordings(history, 3600.0) == history[-1:]
    assert newest_recordings(history, 100 * 3600.0) == history
