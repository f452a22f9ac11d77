"""pipeline.config.twin_entry: a twin is added to a configuration, and nothing else changes."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from pipeline.config.models import ConfigError
from pipeline.config.twin_entry import with_twin

PATH = Path("fantwin.toml")


@pytest.mark.parametrize(
    "text",
    [
        '[[tray]]\nname = "a"\nfans = 2\n',
        'site = "lab"  # ours\n\n  [[ tray ]]  # the only one\n  name = "a"\n  fans = 2\n[viewer]\nserve = false\n',
        '# [[tray]]\n[viewer]\n[[tray]]\nfans = 2\nname = "[[tray]]"\n[tray.source]\nkind = "serial"\n',
    ],
)
def test_the_twin_is_added_and_all_else_stays(text: str) -> None:
    added = with_twin(text, 'dir/a "b".onnx', PATH)
    wanted = tomllib.loads(text)
    wanted["tray"][0]["twin"] = 'dir/a "b".onnx'
    assert tomllib.loads(added) == wanted
    assert [line for line in added.splitlines() if "twin = " not in line] == text.splitlines()


def test_the_ends_of_lines_stay() -> None:
    assert with_twin('[[tray]]\r\nname = "a"\r\n', "a.onnx", PATH) == '[[tray]]\r\ntwin = "a.onnx"\r\nname = "a"\r\n'


@pytest.mark.parametrize(
    "text",
    [
        'tray = [{ name = "a", fans = 2 }]\n',
        'site = """\n[[tray]]\n"""\n[[tray]]\nname = "a"\n',
        '[[tray]]\nname = "a"\n[[tray]]\nname = "b"\n',
        '[[tray]]\nname = "a"\ntwin = "old.onnx"\n',
        "[viewer]\n",
        "[[tray]\n",
    ],
)
def test_a_place_that_is_not_certain_is_refused(text: str) -> None:
    with pytest.raises(
        ConfigError, match=r'fantwin.toml: twin = "a.onnx" cannot be added: write its tray as one section \[\[tray\]\]'
    ):
        with_twin(text, "a.onnx", PATH)
