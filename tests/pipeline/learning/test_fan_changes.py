"""How the speeds of fans have changed, and what is said of fans that cannot be compared."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from fantwin.pipeline.cli.twins.twins import check_line
from fantwin.pipeline.learning.fan_changes import (
    changed_fans,
    changes_from_list,
    changes_to_list,
    fans_changed_alike,
    have_most_changed_alike,
    mean_changes,
)
from fantwin.pipeline.learning.healthy_history import healthy_recordings
from fantwin.pipeline.learning.version_data import Excerpt
from fantwin.pipeline.learning.versions import Check
from fantwin.twin.models.physical import PhysicalModel
from tests.support.commanded_fans import moving, recorded
from tests.support.twin_files import COMMAND_RANGE, write_twin


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
    assert changed_fans(np.array([-0.05, np.nan]), "t-1").startswith("fan 0 is 5.0 % slower")


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
