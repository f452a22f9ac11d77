"""Rerun is pinned to one release in three files, and that release is the one that is tested."""

from __future__ import annotations

import re
import tomllib
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]


def test_the_pin_the_locks_and_what_is_installed_are_the_same_release() -> None:
    """`make rerun-bump` changes all of them."""
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    (pin,) = (each for each in extras["view"] if each.startswith("rerun-sdk"))
    pinned = re.fullmatch(r"rerun-sdk==(\d+\.\d+)\.\*", pin)
    assert pinned is not None, pin
    for lock in ("requirements-image.lock", "requirements-dev.lock"):
        (locked,) = re.findall(r"^rerun-sdk==(\d+\.\d+)\.", (ROOT / lock).read_text(encoding="utf-8"), re.MULTILINE)
        assert locked == pinned[1], lock
    try:
        assert version("rerun-sdk").startswith(f"{pinned[1]}.")
    except PackageNotFoundError:
        pytest.skip("the extra `view` is not installed")
