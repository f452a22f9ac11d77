"""Fixtures that several test modules share."""

from __future__ import annotations

import os
import socket
from pathlib import Path

import pytest
from hypothesis import settings

# The same examples on every run, and no judgement of how long one takes: machines differ.
settings.register_profile("house", derandomize=True, deadline=None)
settings.load_profile("house")


@pytest.fixture
def endpoint() -> str:
    """A bus endpoint on loopback that nobody else uses."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


@pytest.fixture(scope="session")
def measured_data() -> Path:
    """The folder of the measured data sets; skips where they are not."""
    folder = Path(os.environ.get("FANTWIN_DATA", Path(__file__).parents[2] / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no measured data at {folder}; set FANTWIN_DATA, see docs/datasets.md")
    return folder
