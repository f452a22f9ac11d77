"""Chains, commands and a browser in processes, which end with the test that has started them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser

from tests.support.page_browser import running_browser
from tests.support.running_chain import Chain, RunningCommand


@pytest.fixture
def ends() -> Iterator[ExitStack]:
    """What is done at the end of the test."""
    with ExitStack() as stack:
        yield stack


@pytest.fixture
def new_chain(tmp_path: Path, endpoint: str, ends: ExitStack) -> Callable[..., Chain]:
    """Makes a chain in the folder and at the endpoint of the test."""

    def make(*settings: str, endpoint: str = endpoint, **more: Any) -> Chain:
        chain = Chain(tmp_path, endpoint, *settings, **more)
        ends.callback(chain.close)
        return chain

    return make


@pytest.fixture
def start_command(ends: ExitStack) -> Callable[..., RunningCommand]:
    """Starts a command of `fantwin`."""

    def start(*words: object) -> RunningCommand:
        running = RunningCommand(words)
        ends.callback(running.kill)
        return running

    return start


@pytest.fixture(scope="module")
def _browser_of_module() -> Iterator[Browser]:
    with running_browser() as running:
        yield running


@pytest.fixture
def browser(_browser_of_module: Browser) -> Iterator[Browser]:
    """A browser whose pages are closed after the test: they would go on asking for a gateway that has ended."""
    yield _browser_of_module
    for context in _browser_of_module.contexts:
        context.close()
