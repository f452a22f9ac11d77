"""The examples: the commands of each README, typed in a copy of its folder, do what it says."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import pytest

from fantwin.pipeline.selftest.scratch_site import FANTWIN
from tests.support.ports import free_port
from tests.support.running_chain import DEADLINE_S, eventually

EXAMPLES = Path(__file__).parents[2] / "examples"
PROGRAMS = {"fantwin": FANTWIN, "python": [sys.executable]}
SHOWN = {
    "pc": "command",
    "arduino": "more drag",
    "modbus-drive": "command",
    "redfish": "acquisition",
    "drone-logs": "tray1    2 ",
}
"""what the last command of each example shows in the end"""
READY = {"simulate": " fans o", "up": "operators' page", "drive.py": "listens", "controller.py": "listens"}
"""what a command that goes on in the background says when the next one may be typed"""


def typed(readme: Path) -> list[str]:
    """The command lines of a README."""
    return re.findall(r"^    (.*)$", readme.read_text(encoding="utf-8"), re.MULTILINE)


class Terminal:
    """Runs command lines in a folder; those in the background end with it."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._running = ExitStack()

    def __enter__(self) -> Terminal:
        return self

    def __exit__(self, *_: object) -> None:
        self._running.close()

    def type(self, line: str) -> subprocess.CompletedProcess[str]:
        """Run a command to its end, or one in the background until it is ready."""
        words = shlex.split(line.removesuffix("&"))
        words[:1] = PROGRAMS[words[0]]
        if line.endswith("&"):
            self._start(words, READY[next(word for word in words if word in READY)])
            return subprocess.CompletedProcess(words, 0)
        return subprocess.run(words, cwd=self._folder, capture_output=True, text=True, timeout=DEADLINE_S, check=False)

    def _start(self, words: list[str], ready: str) -> None:
        process = subprocess.Popen(words, cwd=self._folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        lines: list[str] = []
        assert process.stdout
        reader = threading.Thread(target=lambda shown=process.stdout: lines.extend(shown))
        self._running.callback(reader.join)
        self._running.callback(process.wait, DEADLINE_S)
        self._running.callback(process.terminate)
        reader.start()
        eventually(
            lambda: process.poll() is not None or any(ready in line for line in list(lines)), f"{words} is ready"
        )
        assert process.poll() is None, lines


@pytest.fixture
def copied(tmp_path: Path, endpoint: str) -> Callable[[str], Path]:
    """Copies an example to the folder of the test, with ports that nobody else has."""

    def copy(name: str) -> Path:
        folder = tmp_path / name
        shutil.copytree(EXAMPLES / name, folder)
        port = str(free_port())
        for path in folder.iterdir():
            text = path.read_text(encoding="utf-8")
            path.write_text(re.sub(r"\b(5020|8000)\b", port, text), encoding="utf-8")
        with (folder / "fantwin.toml").open("a", encoding="utf-8") as configuration:
            configuration.write(f'\n[bus]\nendpoint = "{endpoint}"\n')
            # several sites that start at once may choose the same free ports
            configuration.write(f'[gateway]\nport = {free_port()}\n[launcher]\nwithout = ["viewer"]\n')
        return folder

    return copy


@pytest.mark.slow
@pytest.mark.real_time
@pytest.mark.parametrize("name", SHOWN)
def test_the_commands_of_a_readme_lead_to_what_it_says(name: str, copied: Callable[[str], Path]) -> None:
    folder = copied(name)
    *before, last = typed(folder / "README.md")
    with Terminal(folder) as terminal:
        for line in before:
            done = terminal.type(line)
            assert done.returncode == 0, f"{line}: {done.stdout}{done.stderr}"

        def is_shown() -> bool:
            done = terminal.type(last)
            return done.returncode == 0 and SHOWN[name] in done.stdout

        eventually(is_shown, f"{last} shows {SHOWN[name]}", every_s=2.0)


def test_every_example_is_in_the_list_and_in_the_test() -> None:
    folders = {path.parent.name for path in EXAMPLES.glob("*/README.md")} - {"notebook"}  # which a test of its own runs
    listed = set(re.findall(r"\]\(([\w-]+)/README\.md\)", (EXAMPLES / "README.md").read_text(encoding="utf-8")))
    assert folders == set(SHOWN) == listed - {"notebook"}
