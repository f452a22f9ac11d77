"""Twins that took over while a site was recorded: a replay changes them at the same sample."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from fantwin.pipeline.replay.offline.replay_input import open_replay_input
from fantwin.pipeline.replay.offline.rescoring import rescore
from fantwin.pipeline.tray_scoring import tray_scorer
from fantwin.pipeline.tray_scoring.scorer_state import ScorerState
from fantwin.schemas.enums import Action, FanState, Transition
from tests.support.killed_site import CALIBRATION, FANS, Site, balanced_hybrid
from tests.support.offline_replay import made_equal, recorded, verified
from tests.support.twin_files import made_up_card, small_hybrid, write_twin

ACTIVE = (FanState.ALARM, FanState.RETURNING)


def twin_of(folder: Path, name: str, seed: int, *, calibrated: bool = False) -> bytes:
    card = {"calibration": CALIBRATION} if calibrated else {}
    return write_twin(folder / f"{name}.onnx", small_hybrid(seed), fans=FANS, name=name, **card).read_bytes()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("learned")


@pytest.fixture(scope="module")
def learned(folder: Path) -> Path:
    """No twin, then one, then another one with an alarm active and a fan out of service, then killed stages."""
    site = Site(folder, 7, raw_samples=4, learns=True)
    first, second = twin_of(folder, "tray1-1", 1), twin_of(folder, "tray1-2", 2, calibrated=True)
    site.run(300)
    site.ask(Action.OUT_OF_SERVICE, fan=2)
    site.put_in_force("tray1-1", first)
    site.run(280)
    site.put_in_force("tray1-2", second)
    site.run(120)
    site.kill("scorer")
    site.run(60)
    site.kill("twin_integrator")
    site.run(90)
    site.put_in_force("tray1-1", first)
    site.run(90)
    return site.finished()


def test_what_operators_set_stays_when_a_twin_takes_over_and_alarms_start_again(learned: Path) -> None:
    alarms = recorded(learned, "alarm")
    assert {alarm.fan for alarm in alarms if alarm.transition == Transition.OUT_OF_SERVICE} == {2}
    last_of_fan_2 = [alarm for alarm in alarms if alarm.fan == 2][-1]
    assert last_of_fan_2.out_of_service
    raised = [alarm for alarm in alarms if alarm.transition == Transition.RAISED]
    assert raised
    taken_over_t_ns = recorded(learned, "twin")[1].t_ns
    cleared = [
        alarm for alarm in alarms if not alarm.active and alarm.fan == 0 and alarm.t_ns <= taken_over_t_ns + 50_000_000
    ]
    assert cleared, "an alarm of the former twin ends with it"


def test_a_replay_is_equal_to_the_bit(learned: Path) -> None:
    assert made_equal(verified(learned)) > 700


def test_a_replay_with_one_twin_uses_it_from_the_beginning(learned: Path, folder: Path) -> None:
    with open_replay_input([learned], None, (), folder / "tray1-2.onnx") as replay_input:
        (tray,) = rescore(replay_input, None, verify=False)
    assert tray.not_judged["no_twin"] == 0
    assert tray.scored > 550


def test_a_replay_of_a_part_begins_with_the_twin_that_was_in_force(learned: Path) -> None:
    with open_replay_input([learned], None, (), None, 4.0, 6.0) as replay_input:
        (tray,) = rescore(replay_input, None, verify=False)
    assert tray.scored > 30
    assert tray.not_judged["no_twin"] == 0


def test_a_twin_that_cannot_be_used_is_refused_and_the_former_one_stays(tmp_path: Path) -> None:
    site = Site(tmp_path, 8, raw_samples=4, learns=True)
    site.put_in_force("tray1-1", twin_of(tmp_path, "tray1-1", 1))
    site.run(300)
    site.put_in_force("tray1-2", b"not a twin")
    site.run(60)
    integrator = site.stages["twin_integrator"].core
    assert integrator
    assert integrator.problem().startswith("tray1-2 did not take over: tray1-2: not an ONNX file that can be run")
    assert recorded(site.finished(), "prediction")[-1].twin == "tray1-1"


def test_with_a_new_calibration_alone_what_was_learned_and_alarms_go_on(tmp_path: Path) -> None:
    site = Site(tmp_path, 9, raw_samples=10, learns=True)
    model = small_hybrid(1)
    first = write_twin(tmp_path / "1.onnx", model, fans=FANS, name="tray1-1", calibration=CALIBRATION).read_bytes()
    wider = {**CALIBRATION, "limit_factor": 1.5}
    second = write_twin(tmp_path / "2.onnx", model, fans=FANS, name="tray1-2", calibration=wider).read_bytes()
    site.put_in_force("tray1-1", first)
    site.run(585)
    site.put_in_force("tray1-2", second)
    site.run(200)
    recording = site.finished()
    cards, scores = recorded(recording, "twin"), recorded(recording, "score")
    before = next(score for score in reversed(scores) if score.t_ns[-1] < cards[1].t_ns)
    after = next(score for score in scores if score.t_ns[0] > cards[1].t_ns and score.valid.any())
    stood = np.isin(before.state[-1], ACTIVE)
    assert stood.any() and np.isin(after.state[-1][stood & after.valid[-1]], ACTIVE).all()
    np.testing.assert_allclose(after.expected_residual_rad_s[0], before.expected_residual_rad_s[-1], atol=4.0)
    alarms = recorded(recording, "alarm")
    active = {alarm.fan for alarm in alarms if alarm.transition == Transition.RAISED and alarm.t_ns < cards[1].t_ns}
    assert active
    assert not [alarm for alarm in alarms if alarm.transition == Transition.RAISED and alarm.t_ns > cards[1].t_ns]
    assert made_equal(verified(recording)) > 600


def test_wear_goes_on_in_a_replay_as_it_did_when_a_twin_took_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second twin takes one more of the command for healthy."""
    monkeypatch.setattr(tray_scorer, "WEAR_EVERY_S", 1.0)
    site = Site(tmp_path, 7, raw_samples=20, learns=True)
    model = balanced_hybrid()
    site.put_in_force("tray1-1", write_twin(tmp_path / "1.onnx", model, fans=FANS, name="tray1-1").read_bytes())
    site.run(1200)
    balance = asdict(made_up_card(model, FANS).balance) | {"friction": [1.0] * FANS}
    second = write_twin(tmp_path / "2.onnx", model, fans=FANS, name="tray1-2", balance=balance)
    site.put_in_force("tray1-2", second.read_bytes())
    site.run(1200)
    recording, replayed = site.finished(), tmp_path / "replayed.mcap"
    with open_replay_input([recording], None, (), None) as replay_input:
        (tray,) = rescore(replay_input, replayed, verify=True)
    assert made_equal(tray) > 2200
    of_recorded, of_replayed = (ScorerState.of(recorded(path, "snapshot")[-1]) for path in (recording, replayed))
    assert of_replayed.wear == of_recorded.wear
    arrays, fan = of_recorded.arrays, of_recorded.wear.fans[1]
    assert arrays["wear.has_shift"][1] and arrays["wear.joined_variance"][1] > 0.0, "there are points by both twins"
    assert abs(fan["change"]) < 0.03, "and no step between them"
