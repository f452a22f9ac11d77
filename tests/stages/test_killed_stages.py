"""Stages of a tray that are killed one after the other: no alarm is forgotten, and none is raised again."""

from __future__ import annotations

from pathlib import Path

import pytest

from fantwin.pipeline.recordings.reading import read_recording
from fantwin.schemas.enums import Transition
from fantwin.schemas.messages import Alarm
from tests.support.killed_site import Site

KILLED_AT = 200
"""the sample at which they are killed: in the fault of fan 0, while all samples since the first are still kept"""


def alarms_of(folder: Path, *killed: str) -> list[Alarm]:
    folder.mkdir()
    site = Site(folder, seed=1)
    site.run(KILLED_AT)
    for stage in killed:
        site.kill(stage)
    site.run(50)
    messages = (envelope.message for envelope in read_recording(site.finished(), topics=("alarm",)))
    return [each for each in messages if isinstance(each, Alarm) and each.transition != Transition.DIAGNOSED]


@pytest.fixture(scope="module")
def expected(tmp_path_factory: pytest.TempPathFactory) -> Alarm:
    (alarm,) = alarms_of(tmp_path_factory.mktemp("site") / "alone")
    return alarm


@pytest.mark.parametrize(
    "killed",
    [("scorer", "twin_integrator", "scorer"), ("resampler", "twin_integrator", "scorer")],
    ids="+".join,
)
def test_when_all_that_was_kept_comes_again_no_alarm_is_forgotten_or_raised_again(
    killed: tuple[str, ...], tmp_path: Path, expected: Alarm
) -> None:
    alarms = alarms_of(tmp_path / "killed", *killed)
    raised = [(each.fan, each.onset_t_ns) for each in alarms if each.transition == Transition.RAISED]
    assert raised == [(expected.fan, expected.onset_t_ns)]
    assert [each.active for each in alarms] == [True] * len(alarms)
