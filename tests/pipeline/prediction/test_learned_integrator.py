"""The integrator of a tray that learns its twin: at which sample a twin takes over."""

from __future__ import annotations

import numpy as np
import pytest

from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.prediction.learned_integrator import MOST_COMING, LearnedTwinIntegrator
from fantwin.pipeline.prediction.twin_file import TwinFile
from fantwin.schemas.blocks import cut
from fantwin.schemas.messages import Grid, Message, ModelCard, NewTwin, Prediction
from fantwin.stages.twin_integrator import TwinIntegratorConfig, TwinIntegratorCore
from tests.support.integrated_twins import EPOCH_NS, STEP_NS, grid_of
from tests.support.twin_files import small_hybrid, write_twin

FANS = 2
TRAY = TrayConfig.model_validate({"name": "tray1", "fans": FANS})


@pytest.fixture(scope="module")
def twins(tmp_path_factory: pytest.TempPathFactory) -> list[bytes]:
    folder = tmp_path_factory.mktemp("twins")
    return [
        write_twin(folder / f"{seed}.onnx", small_hybrid(seed), fans=FANS, name=f"tray1-{seed}").read_bytes()
        for seed in (1, 2)
    ]


@pytest.fixture
def integrator() -> LearnedTwinIntegrator:
    def core_of(twin: TwinFile, first_t_ns: int, content: bytes) -> TwinIntegratorCore:
        return TwinIntegratorCore(twin, TwinIntegratorConfig(), first_t_ns, content=content)

    return LearnedTwinIntegrator(TRAY, core_of)


def time_of(sample: int) -> int:
    return EPOCH_NS + sample * STEP_NS


def grid(first: int, end: int) -> Grid:
    columns = np.full((end - first, FANS), 50.0)
    return grid_of(columns, columns, first=first)


def new_twin(content: bytes, number: int, first_sample: int | None = None) -> NewTwin:
    first_t_ns = 0 if first_sample is None else time_of(first_sample)
    name = f"tray1-{number}"
    return NewTwin(t_ns=1, twin=name, sha256=name, content=content, first_sample_t_ns=first_t_ns)


def twin_of_each_sample(messages: list[Message]) -> list[str]:
    return [p.twin for p in messages if isinstance(p, Prediction) for _ in p.t_ns]


@pytest.mark.parametrize("size", [7, 100])
def test_twins_that_name_their_first_sample_take_over_there_however_the_grid_is_cut(integrator, twins, size):
    messages = [*integrator.step(new_twin(twins[0], 1, 30)), *integrator.step(new_twin(twins[1], 2, 65))]
    for first in range(0, 100, size):
        messages += integrator.step(cut(grid(0, 100), first, min(first + size, 100)))
    assert twin_of_each_sample(messages) == [""] * 30 + ["tray1-1"] * 35 + ["tray1-2"] * 35
    cards = [message for message in messages if isinstance(message, ModelCard)]
    assert [(card.twin, card.t_ns) for card in cards] == [("tray1-1", time_of(30)), ("tray1-2", time_of(65))]


def test_a_twin_that_names_no_sample_takes_over_with_the_next_block(integrator, twins):
    integrator.step(new_twin(twins[0], 1))
    assert twin_of_each_sample(integrator.step(grid(0, 50))) == ["tray1-1"] * 50
    integrator.step(new_twin(twins[1], 2))
    assert twin_of_each_sample(integrator.step(grid(40, 60))) == ["tray1-1"] * 10, "it begins with old samples"
    assert twin_of_each_sample(integrator.step(grid(60, 70))) == ["tray1-2"] * 10


def test_a_twin_whose_first_sample_has_passed_takes_over_at_the_next_new_sample(integrator, twins):
    integrator.step(new_twin(twins[0], 1))
    integrator.step(grid(0, 50))
    integrator.step(new_twin(twins[1], 2, 20))
    assert twin_of_each_sample(integrator.step(grid(40, 60))) == ["tray1-2"] * 10


@pytest.mark.parametrize("first_sample", [None, 40])
def test_a_later_message_replaces_the_twins_that_were_to_come_after_it(integrator, twins, first_sample):
    integrator.step(new_twin(twins[0], 1, 50))
    integrator.step(new_twin(twins[1], 2, first_sample))
    expected = [""] * (first_sample or 0) + ["tray1-2"] * (100 - (first_sample or 0))
    assert twin_of_each_sample(integrator.step(grid(0, 100))) == expected


def test_few_twins_are_kept_however_many_are_published(integrator, twins):
    for number in range(100):
        integrator.step(new_twin(twins[0], number, 1000 + number))
    assert len(integrator._coming) == MOST_COMING
