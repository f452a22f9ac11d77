"""The scorer of a tray whose twin is learned, with a twin that cannot be used."""

from __future__ import annotations

import numpy as np
import pytest

from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.tray_scoring import learned_scorer
from fantwin.pipeline.tray_scoring.learned_scorer import LearnedTwinScorer
from fantwin.schemas.messages import ModelCard, Score
from tests.support.scored_blocks import prediction_of


def test_a_twin_that_cannot_be_used_is_reported_and_tried_once_for_each_time_that_it_arrives(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tried: list[str] = []
    load = learned_scorer.tray_twin
    monkeypatch.setattr(
        learned_scorer, "tray_twin", lambda path, *rest: (tried.append(str(path)), load(path, *rest))[1]
    )
    scorer = LearnedTwinScorer(TrayConfig(name="tray1", fans=1), lambda *_: pytest.fail("there is no twin"), None)
    for arrived in (1, 2):
        scorer.step(ModelCard(t_ns=0, twin="t", kind="hybrid", sha256="", content=b"no twin", card_json="{}"))
        for block in range(3):
            (score,) = scorer.step(prediction_of(np.zeros(1), first=10 * arrived + block))
            assert isinstance(score, Score) and not score.valid.any()
        assert tried == ["t"] * arrived and scorer.problem()
