"""Gateways that tests open, and free runs that start from one reading."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from fantwin.pipeline.prediction import free_run
from tests.support.running_gateway import RunningGateway


@pytest.fixture(scope="module")
def one_reading_starts() -> Iterator[None]:
    """A free run starts from one reading, so that it has the speed of that sample."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(free_run, "START_SAMPLES", 1)
        yield


@pytest.fixture
def opened(tmp_path: Path) -> Iterator[Callable[..., RunningGateway]]:
    """Opens gateways, which are closed at the end."""
    running: list[RunningGateway] = []

    def open_one(folder: Path = tmp_path, *words: Any, **settings: Any) -> RunningGateway:
        running.append(RunningGateway(folder, *words, **settings))
        return running[-1]

    yield open_one
    for each in running:
        each.close()
