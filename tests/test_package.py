"""The wheel: one package with all that runs, beside whatever else a user has."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import fantwin
from tests.support.built_wheel import FOLDERS, ROOT, copied_source, unpacked_wheel

DATA = ("*.toml", "*.onnx", "*.sh", "*.proto", "*.pyi", "*.html", "*.js", "*.css", "*.svg", "py.typed")


@pytest.fixture(scope="module")
def unpacked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of an unpacked wheel, as site-packages would be."""
    source, built = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("built")
    return unpacked_wheel(copied_source(source), built)


def test_the_wheel_holds_one_package_with_every_file_of_the_product(unpacked):
    assert {path.name.partition("-")[0] for path in unpacked.iterdir()} == {"fantwin"}
    patterns = ("*.py", *DATA)
    ours = {path.relative_to(ROOT) for name in FOLDERS for kind in patterns for path in (ROOT / name).rglob(kind)}
    # through a link or not, a file of the product is below `fantwin/`
    expected = {path if path.parts[0] == "fantwin" else Path("fantwin") / path for path in ours}
    found = {path.relative_to(unpacked) for path in (unpacked / "fantwin").rglob("*") if path.is_file()}
    assert expected - found == set()


def test_the_wheel_has_every_file_of_deploy_with_its_content(unpacked):
    """Also those that are links, as pip makes none."""
    files = [path for path in (ROOT / "deploy").rglob("*") if path.is_file()]
    there = unpacked / "fantwin" / "deploy"
    assert {path for path in there.rglob("*") if path.is_file()} == {
        there / path.relative_to(ROOT / "deploy") for path in files
    }
    for path in files:
        assert (there / path.relative_to(ROOT / "deploy")).read_bytes() == path.read_bytes()


def test_folders_and_files_of_a_user_with_our_names_do_no_harm(unpacked, tmp_path):
    for name in FOLDERS[1:]:
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text("raise SystemExit('a file of the user was imported')")
    (tmp_path / "client.py").write_text("raise SystemExit('a file of the user was imported')")
    code = (
        "import sys; sys.path.insert(1, sys.argv[1]); import fantwin; fantwin.connect, fantwin.read_arrays;"
        "from fantwin.pipeline.config.registry import STAGES; print(len([row.load() for row in STAGES.values()]),"
        "fantwin.__file__)"
    )
    words = [sys.executable, "-c", code, unpacked]  # `-c` puts the folder of the user first
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
    stages, where = done.stdout.split()
    assert int(stages) > 10 and Path(where).is_relative_to(unpacked), done.stderr


def test_the_interface_is_what_the_package_names():
    assert {name for name in fantwin.__all__ if callable(getattr(fantwin, name))} == set(fantwin.__all__)
    with pytest.raises(AttributeError, match="no attribute 'read_arays'"):
        _ = fantwin.read_arays
