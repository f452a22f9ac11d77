"""How the speeds of fans have changed, and checks of that where much of their running was near alarms."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from fantwin.pipeline.cli.twins.twins import check_line
from fantwin.pipeline.learning import next_version
from fantwin.pipeline.learning.fan_changes import (
    changed_fans,
    changes_from_list,
    changes_to_list,
    fans_changed_alike,
    have_most_changed_alike,
    mean_changes,
)
from fantwin.pipeline.learning.healthy_history import healthy_recordings, recordings_near_alarms
from fantwin.pipeline.learning.next_version import make_next_version
from fantwin.pipeline.learning.version_data import Excerpt, spread_parts
from fantwin.pipeline.learning.versions import Check, TwinVersions
from fantwin.schemas.fan_names import FanNames
from fantwin.schemas.messages import Array
from fantwin.schemas.units import NS_PER_S
from fantwin.twin.models.physical import PhysicalModel
from tests.support.commanded_fans import GAIN, RATE_HZ, START_S, add_history, moving, recorded
from tests.support.learned_versions import version
from tests.support.twin_files import COMMAND_RANGE, write_twin


class OfferError(Exception):
    """A version was to be made."""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a reference of two fans, and a check that found nothing."""

    def offer(_work: object, changed: str) -> None:
        raise OfferError(changed)

    monkeypatch.setattr("fantwin.pipeline.learning.versions.REFERENCE_S", 60.0)
    monkeypatch.setattr(next_version, "CHECKED_S", 400.0)
    monkeypatch.setattr(next_version, "LEAST_CHECKED_S", 90.0)
    monkeypatch.setattr(next_version._Work, "offered", offer)
    run(tmp_path, 0, 400.0)
    versions, recordings = TwinVersions(tmp_path, "tray1"), healthy_recordings(tmp_path)
    twin = write_twin(versions.file("tray1-1"), PhysicalModel(), 2)
    change = changes_to_list(mean_changes(twin, spread_parts(recordings)))
    spans = tuple(each.span for each in recordings)
    versions.add(version("tray1-1", 2, made_t_ns=spans[-1][1], learned_spans=spans, change=change))
    check(tmp_path)
    return tmp_path


def run(
    folder: Path, first_s: int, seconds: float, factor: tuple[float, float] | Array = (1.0, 1.0), **more: bool
) -> None:
    """Always the same commands, so that the change of a fan is that of its factor."""
    command = np.tile(moving(100.0), (round(seconds / 100.0), 1))
    add_history(folder, first_s, command, GAIN * command * np.array(factor), RATE_HZ, **more)


def check(folder: Path) -> Check:
    """The check that was kept, of fans that have not changed."""
    assert make_next_version(folder, "tray1", 1.0, lambda _line: None, only_if_changed=True) is None
    kept = TwinVersions(folder, "tray1").read().check
    assert kept
    return kept


def test_what_is_between_the_alarms_of_one_fan_is_not_taken_as_unchanged(folder: Path) -> None:
    for day in (1, 2, 3, 4):
        run(folder, 10_000 * day, 300.0, (1.0, 0.95), has_alarm=True)
        run(folder, 10_000 * day + 1000, 100.0, (1.0, 0.95))
        assert check(folder).found == "", "too little is new: what changed would be diluted by the time before"
    run(folder, 50_000, 300.0, (1.0, 0.95), has_alarm=True)
    run(folder, 51_000, 100.0, (1.0, 0.95))
    with pytest.raises(OfferError, match=r"^fan 1 is \d\.\d % slower"):
        check(folder)


def test_shortly_after_commissioning_a_check_near_alarms_is_no_failure(folder: Path) -> None:
    TwinVersions(folder, "tray1").commission((START_S + 5000) * NS_PER_S)
    run(folder, 5000, 200.0, (1.0, 0.94), has_alarm=True)
    before = check(folder)
    assert before.near_t_ns // NS_PER_S - START_S == 5199
    assert before.t_ns // NS_PER_S - START_S == 399, "of healthy running nothing new was checked"
    run(folder, 5300, 100.0, (1.0, 0.94))
    with pytest.raises(OfferError, match=r"^fan 1 is \d\.\d % slower"):
        check(folder)


def test_without_healthy_running_since_a_version_near_alarms_are_checked(folder: Path) -> None:
    versions = TwinVersions(folder, "tray1")
    since_t_ns = (START_S + 4000) * NS_PER_S
    change = versions.all()[0].change
    versions.add(version("tray1-2", 2, since_t_ns=since_t_ns, made_t_ns=since_t_ns, outcome="offered", change=change))
    versions.file("tray1-2").write_bytes(versions.file("tray1-1").read_bytes())
    versions.use("tray1-2")
    run(folder, 5000, 200.0, has_alarm=True)
    assert check(folder).near_t_ns // NS_PER_S - START_S == 5199


def test_an_offer_is_not_learned_from_a_recording_that_began_before_the_change(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(next_version, "CHECKED_S", 800.0)
    samples = round(1600.0 * RATE_HZ)
    run(folder, 5000, 1600.0, np.where(np.arange(samples)[:, np.newaxis] < 1000 * RATE_HZ, 1.0, 1.1))
    run(folder, 6600, 300.0, (1.1, 1.1), has_alarm=True)
    run(folder, 7000, 700.0, (1.1, 1.1), has_alarm=True)
    versions = TwinVersions(folder, "tray1")
    near_alarms = recordings_near_alarms(folder)
    work = next_version._Work(
        folder, "x", versions.file, versions.read(), healthy_recordings(folder), near_alarms, 1.0, lambda _line: None
    )
    assert work._first_after_change() == near_alarms[0]


def test_a_fan_at_commands_that_the_reference_does_not_know_is_not_comparable(tmp_path: Path) -> None:
    command = moving(120.0)
    command[:, 1] = 2.0 * COMMAND_RANGE[1]
    recorded(tmp_path, 0.0, command)
    (recording,) = healthy_recordings(tmp_path)
    twin = write_twin(tmp_path / "twin.onnx", PhysicalModel(), 2)
    change = mean_changes(twin, [Excerpt(recording.path, 0.0, 60.0), Excerpt(recording.path, 60.0, 119.0)])
    assert math.isfinite(change[0])
    assert math.isnan(change[1])


def test_a_fan_with_few_readings_is_not_comparable(tmp_path: Path) -> None:
    command = moving(120.0)
    command[10 : 9 * len(command) // 10, 1] = 2.0 * COMMAND_RANGE[1]
    command[len(command) // 20 :, 1] = 2.0 * COMMAND_RANGE[1]
    recorded(tmp_path, 0.0, command)
    (recording,) = healthy_recordings(tmp_path)
    twin = write_twin(tmp_path / "twin.onnx", PhysicalModel(), 2)
    assert np.isnan(mean_changes(twin, [Excerpt(recording.path, 0.0, 119.0)])).tolist() == [False, True]


def test_a_fan_that_is_not_comparable_is_no_change_and_does_not_hide_others() -> None:
    assert changed_fans(np.array([0.01, np.nan]), "t-1") == ""
    assert changed_fans(np.array([np.nan, np.nan]), "t-1") == ""
    assert changed_fans(np.array([0.05, np.nan, 0.04]), "t-1").startswith(
        "all 2 fans that can be compared are 4.5 % faster than when t-1 was made"
    )
    assert changed_fans(np.array([0.05, 0.04]), "t-1").startswith("all fans are 4.5 % faster")
    assert changed_fans(np.array([-0.05, np.nan, 0.0]), "t-1").startswith("fan 0 is 5.0 % slower")
    worn = changed_fans(np.array([0.01, 0.04, 0.032, 0.03]), "t-1")  # all were changed, and the first is worn
    assert worn.startswith("3 of 4 fans are 3.4 % faster than when t-1 was made, fan 0 is 1.0 % faster; if maintenance")
    assert changed_fans(np.array([-0.04, 0.0, 0.001, -0.04]), "t-1").startswith("fan 0 is 4.0 % slower, fan 3 is 4.0")
    named = changed_fans(np.array([-0.05, np.nan]), "t-1", FanNames(("CPU",)))
    assert named.startswith("CPU (fan 0) is 5.0 % slower")


def test_a_fan_with_a_fault_does_not_hide_what_the_others_have_alike() -> None:
    for one in (-0.30, 0.12, -1.0):
        assert fans_changed_alike(np.array([0.05] * 7 + [one])).tolist() == list(range(7))
        words = changed_fans(np.array([0.05] * 7 + [one]), "t-1")
        assert words.startswith("7 of 8 fans are 5.0 % faster than when t-1 was made, fan 7 is ")


def test_most_have_changed_only_if_most_of_a_tray_have_changed_more_than_healthy_fans_do() -> None:
    assert have_most_changed_alike(np.array([0.05, 0.04]))
    assert have_most_changed_alike(np.array([0.05, 0.04, 0.04, np.nan, 0.0]))
    assert not have_most_changed_alike(np.array([-0.04, -0.021])), "one is faulty, the other drifts"
    assert not have_most_changed_alike(np.array([-0.058, *[-0.0291] * 4]))
    assert not have_most_changed_alike(np.array([0.05, 0.04, np.nan, np.nan]))
    assert not have_most_changed_alike(np.array([0.05, -0.05]))
    assert not have_most_changed_alike(np.array([0.05]))
    assert not have_most_changed_alike(np.array([0.0, np.nan, 0.0]))
    assert not have_most_changed_alike(np.array([np.nan]))


def test_the_list_of_versions_holds_no_nan_and_the_text_names_the_fan() -> None:
    change = changes_to_list(np.array([0.012, np.nan]))
    assert change == (pytest.approx(0.012), None)
    np.testing.assert_array_equal(changes_from_list(change), [0.012, np.nan])
    check = Check(t_ns=0, reference="t-1", change=change, found="", spans=())
    assert Check.model_validate_json(check.model_dump_json()) == check
    assert check_line(check).endswith(
        "since t-1: +1.2 %, not comparable; fan 1: too few readings at commands that t-1 was trained on"
    )
    assert "; rear (fan 1): too few readings" in check_line(check, FanNames(("CPU", "rear")))
