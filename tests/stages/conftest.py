"""Gateways that tests open."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.support.running_gateway import RunningGateway


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
