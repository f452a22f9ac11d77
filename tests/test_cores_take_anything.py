"""Whatever decodes, no core raises on it: messages of the declared type with any values in them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pipeline.config import TrayConfig
from pipeline.stage import Core
from pipeline.twin_file import TwinFile
from schemas.codec import decode, encode
from schemas.messages import Alarm, Grid, Header, Health, Message, ModelCard, Prediction, Raw, Score
from stages.resampler import ResamplerConfig, ResamplerCore
from stages.scorer import ScorerConfig, ScorerCore
from stages.twin_integrator import TwinIntegratorConfig, TwinIntegratorCore
from stages.viewer import ViewerCore
from tests.message_strategies import any_message
from tests.test_viewer import FakeSink
from tests.twin_files import write_twin

FANS = 2
NO_SLOW_CHECK = settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow])


def sessions(*kinds: type[Message]) -> st.SearchStrategy[list[Message]]:
    """Messages in a row, most of them of the tray's own number of fans, as they come off the bus."""
    messages = st.one_of(*(any_message(kind, fans=st.sampled_from([FANS, FANS, FANS, 3])) for kind in kinds))
    return st.lists(messages, max_size=6)


def survives(core: Core, session: list[Message], tray: str = "tray1") -> None:
    """Hand over a session as the runner does; what comes out can be encoded."""
    out: list[Any] = []
    with np.errstate(all="ignore"):
        for number, message in enumerate(session):
            stamped = replace(message, header=Header("p", number, tray))
            out += core.step(decode(type(message), encode(stamped)))
            out += core.tick(number * 50_000_000)
            assert core.problem() is not None and core.counters() is not None
        out += core.close()
    for message in out:
        encode(message)


@NO_SLOW_CHECK
@given(sessions(Raw))
def test_the_resampler_takes_anything(session: list[Message]) -> None:
    survives(ResamplerCore(FANS, ResamplerConfig()), session)


@pytest.fixture(scope="module")
def twin(tmp_path_factory: pytest.TempPathFactory) -> TwinFile:
    folder: Path = tmp_path_factory.mktemp("twin")
    return TwinFile.load(write_twin(folder / "twin.onnx", fans=FANS), FANS)


@NO_SLOW_CHECK
@given(session=sessions(Grid))
def test_the_twin_integrator_takes_anything(twin: TwinFile, session: list[Message]) -> None:
    config = TwinIntegratorConfig(start_samples=1, warm_up_s=0.0)
    survives(TwinIntegratorCore(twin, config, 0), session)


@NO_SLOW_CHECK
@given(sessions(Prediction))
def test_the_scorer_takes_anything(session: list[Message]) -> None:
    survives(ScorerCore(FANS, "rpm", ScorerConfig()), session)


@NO_SLOW_CHECK
@given(sessions(Score, Alarm, ModelCard, Health), st.sampled_from(["tray1", "tray1", "elsewhere"]))
def test_the_viewer_takes_anything(session: list[Message], tray: str) -> None:
    survives(ViewerCore([TrayConfig(name="tray1", fans=FANS)], FakeSink()), session, tray)
