"""Recordings that several test modules replay."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.support.offline_replay import recording_of

SAMPLES = 4
"""number in a raw message: four take hardly more time than one"""


@pytest.fixture(scope="session")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Long enough for alarms to be raised and cleared."""
    return recording_of(tmp_path_factory.mktemp("undisturbed"), 1, 600, raw_samples=SAMPLES)


@pytest.fixture(scope="session")
def short(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recording_of(tmp_path_factory.mktemp("short"), 3, 300, raw_samples=SAMPLES)


@pytest.fixture(scope="session")
def integrator_killed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recording_of(
        tmp_path_factory.mktemp("integrator"), 4, 150, 150, raw_samples=SAMPLES, killed="twin_integrator"
    )


@pytest.fixture(scope="session")
def scorer_killed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The scorer is killed while an alarm is active, and continues from its snapshot."""
    folder = tmp_path_factory.mktemp("scorer")
    return recording_of(folder, 1, 215, 100, raw_samples=SAMPLES, killed="scorer", calibrated=True)
