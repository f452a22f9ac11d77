"""A release: one version, one place for addresses, a source distribution with everything, licences, workflows."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.support import licences
from tests.support.built_wheel import unpacked_wheel

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
VERSION = PROJECT["version"]
FORGE = re.compile(r"example\.org/fantwin|(?:github|gitlab|codeberg|bitbucket)\.(?:com|org|io)/[\w-]*/?fantwin")
SDIST = "import sys, setuptools.build_meta as backend; print(backend.build_sdist(sys.argv[1]))"
FORGE_FILES = {
    "vendor.github-workflows": "workflows/*.yml",
    "custom.github-workflows-require-timeout": "workflows/*.yml",
    "vendor.github-issue-forms": "ISSUE_TEMPLATE/[!c]*.yml",
    "vendor.github-issue-config": "ISSUE_TEMPLATE/config.yml",
}
"""schemas by name, and the files of each"""


def read(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def tracked() -> list[str]:
    """The files of the repository, as git knows them."""
    words = ["git", "-c", "safe.directory=*", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    if not (ROOT / ".git").exists():
        pytest.skip("this is no checkout: git has no list of its files")
    listed = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True).stdout.split("\0")
    return sorted(name for name in set(listed) if name and (ROOT / name).exists())


def test_every_file_that_names_the_version_names_that_of_the_project() -> None:
    chart = yaml.safe_load(read("deploy/kubernetes/fantwin/Chart.yaml"))
    assert chart["appVersion"] == VERSION
    assert chart["version"].replace("-", "") == VERSION  # Helm has a form of its own
    for page in ("README.md", "docs/how-to/install.md"):
        assert set(re.findall(r"fantwin-(\S+)-py3-none-any\.whl", read(page))) == {VERSION}
    newest = re.search(r"^## \[(.*?)\] - ", read("CHANGELOG.md"), re.MULTILINE)
    assert newest and newest[1] == VERSION
    assert f"(now {VERSION})" in read("SECURITY.md")


def test_addresses_of_the_project_stand_in_one_file(tracked: list[str]) -> None:
    assert all(FORGE.search(address) for address in PROJECT["urls"].values())
    named: set[str] = set()
    for name in tracked:
        if (ROOT / name).is_file() and name != "tests/test_release.py":
            named |= {name} if FORGE.search((ROOT / name).read_text(encoding="utf-8", errors="ignore")) else set()
    assert named == {"pyproject.toml"}


@pytest.mark.slow
def test_a_source_distribution_has_the_whole_repository_and_builds_the_same_wheel(tracked, tmp_path) -> None:
    """Out of a copy without tags and history."""
    source = tmp_path / "source"
    for name in tracked:
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, source / name, follow_symlinks=False)
    subprocess.run([sys.executable, "-c", SDIST, tmp_path], cwd=source, capture_output=True, check=True)
    with tarfile.open(tmp_path / f"fantwin-{VERSION}.tar.gz") as archive:
        archive.extractall(tmp_path, filter="data")
    unpacked = tmp_path / f"fantwin-{VERSION}"
    assert [name for name in tracked if not (unpacked / name).exists()] == []
    for name in ("ours", "theirs"):
        (tmp_path / name).mkdir()
    ours, theirs = unpacked_wheel(source, tmp_path / "ours"), unpacked_wheel(unpacked, tmp_path / "theirs")
    files = [{path.relative_to(folder) for path in folder.rglob("*")} for folder in (ours, theirs)]
    assert files[0] == files[1]
    assert Path("fantwin/py.typed") in files[1]
    environment = {**os.environ, "PYTHONPATH": str(theirs)}
    words = [sys.executable, "-m", "fantwin", "--version"]
    shown = subprocess.run(words, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True).stdout
    assert shown == f"fantwin {VERSION}\n"


def test_the_page_of_licences_is_that_of_the_locks() -> None:
    listed = re.findall(r"^\| (\S+) \| (\S+) \| (.*) \|$", licences.PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    packages = [(name, its) for name, its, _ in listed if name != "package"]
    assert packages == [(name, its) for _, name, its in licences.rows()], "make licences"
    assert all(licence for _, _, licence in listed)
    numpy = next(licence for name, _, licence in listed if name == "numpy")
    assert numpy == licences.licence("numpy") or version("numpy") != dict(packages)["numpy"]


@pytest.mark.parametrize("kind", FORGE_FILES)
def test_the_files_of_the_forge_have_its_form(kind: str) -> None:
    files = sorted((ROOT / ".github").glob(FORGE_FILES[kind]))
    words = [sys.executable, "-m", "check_jsonschema", "--builtin-schema", kind, *files]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert files and done.returncode == 0, done.stdout


def steps() -> list[dict[str, Any]]:
    """Of all workflows."""
    files = [yaml.safe_load(path.read_text(encoding="utf-8")) for path in (ROOT / ".github/workflows").glob("*.yml")]
    return [step for file in files for job in file["jobs"].values() for step in job["steps"]]


def test_workflows_run_what_the_makefile_has_with_actions_of_one_version_each() -> None:
    targets = set(re.findall(r"^([a-z-]+):", read("Makefile"), re.MULTILINE))
    used = {
        target
        for step in steps()
        for line in re.findall(r"\bmake (.*)", step.get("run", ""))
        for target in line.split()
    }
    assert {"check", "dist", "site"} <= used <= targets
    actions = {step["uses"] for step in steps() if "uses" in step}
    assert all(re.fullmatch(r"[\w/-]+@v\d+\.\d+\.\d+", action) for action in actions)
    assert len({action.split("@")[0] for action in actions}) == len(actions)
    assert ".ci/run" in {step.get("run") for step in steps()}


def test_the_workflows_try_each_python_that_the_package_claims() -> None:
    claimed = {words.split(" :: ")[-1] for words in PROJECT["classifiers"] if re.search(r":: 3\.\d+$", words)}
    matrix = yaml.safe_load(read(".github/workflows/ci.yml"))["jobs"]["test"]["strategy"]["matrix"]
    assert set(matrix["python"]) == claimed
    assert {row["runner"] for row in matrix["include"]} == {"ubuntu-24.04-arm"}


def test_hooks_before_a_commit_are_commands_of_make_check() -> None:
    hooks = yaml.safe_load(read(".pre-commit-config.yaml"))["repos"][0]["hooks"]
    commands = [hook["entry"].removesuffix(" --force-exclude").replace(".venv/bin", "$(BIN)") for hook in hooks]
    assert len(commands) == 3 and [command for command in commands if f"\t{command}" not in read("Makefile")] == []
