"""pipeline.config.loading: a twin is added to a configuration, and nothing else changes."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from fantwin.pipeline.config.loading import load_config, with_twin, write_twin
from fantwin.pipeline.config.settings import ConfigError

PATH = Path("fantwin.toml")


@pytest.mark.parametrize(
    "text",
    [
        '[[tray]]\nname = "a"\nfans = 2\n',
        'site = "lab"  # ours\n\n  [[ tray ]]  # the only one\n  name = "a"\n  fans = 2\n[viewer]\ngrpc_port = 0\n',
        '# [[tray]]\n[viewer]\n[[tray]]\nfans = 2\nname = "a"\n[tray.source]\nkind = "[[tray]]"\n',
        'site = """\n[[tray]]\n"""\n[[tray]]\nname = "a"\n',
        '[[tray]]\nname = "b"  # old\ntwin = "b.onnx"\n[tray.source]\nkind = "serial"\n\n[[tray]]  # new\nname = "a"\n',
        '[[tray]]\nname = "a"\n[viewer]\n[[tray]]\nname = "b"\n',
    ],
)
def test_the_twin_is_added_to_its_tray_and_all_else_stays(text: str) -> None:
    added = with_twin(text, "a", 'dir/a "b".onnx', PATH)
    wanted = tomllib.loads(text)
    (tray,) = (tray for tray in wanted["tray"] if tray["name"] == "a")
    tray["twin"] = 'dir/a "b".onnx'
    assert tomllib.loads(added) == wanted
    entry = 'twin = "dir/a \\"b\\".onnx"'
    assert [line for line in added.splitlines() if line.strip() != entry] == text.splitlines()


def test_trays_get_their_twins_one_after_the_other() -> None:
    text = '[[tray]]\nname = "a"\n[[tray]]  # upper\nname = "b"\n'
    both = with_twin(with_twin(text, "b", "b.onnx", PATH), "a", "a.onnx", PATH)
    assert both == '[[tray]]\ntwin = "a.onnx"\nname = "a"\n[[tray]]  # upper\ntwin = "b.onnx"\nname = "b"\n'


def test_the_ends_of_lines_stay() -> None:
    added = with_twin('[[tray]]\r\nname = "a"\r\n', "a", "a.onnx", PATH)
    assert added == '[[tray]]\r\ntwin = "a.onnx"\r\nname = "a"\r\n'


@pytest.mark.parametrize(
    "text",
    [
        'tray = [{ name = "a", fans = 2 }]\n',
        '[[tray]]\nname = "b"\n',
        '[[tray]]\nname = "a"\n[[tray]]\nname = "a"\n',
        '[[tray]]\nname = "a"\ntwin = "old.onnx"\n[[tray]]\nname = "b"\n',
        "[[tray]]\nfans = 2\n",
        "tray = 3\n",
        "[viewer]\n",
        "[[tray]\n",
    ],
)
def test_a_place_that_is_not_certain_is_refused(text: str) -> None:
    words = r'fantwin.toml: twin = "a.onnx" cannot be added: write tray a as one section \[\[tray\]\] without twin'
    with pytest.raises(ConfigError, match=words):
        with_twin(text, "a", "a.onnx", PATH)


def test_a_twin_is_written_into_the_file_by_its_path_from_there(tmp_path: Path) -> None:
    path = tmp_path / "fantwin.toml"
    path.write_text('[[tray]]  # upper\nname = "a"\nfans = 1\nport = "line"\n', encoding="utf-8")
    path.chmod(0o640)
    settings = load_config(path, stages=())
    path.write_text(f"# edited meanwhile\n{settings.text}", encoding="utf-8")
    assert write_twin(settings, "a", tmp_path / "twins" / "a.onnx") == "twins/a.onnx"
    after = '# edited meanwhile\n[[tray]]  # upper\ntwin = "twins/a.onnx"\nname = "a"\nfans = 1\nport = "line"\n'
    assert path.read_text(encoding="utf-8") == after
    assert path.stat().st_mode & 0o777 == 0o640
    assert list(tmp_path.iterdir()) == [path]
