"""The command line: every command explains itself, and every mistake is one line and an exit code."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tomllib
from inspect import getdoc
from pathlib import Path

import pytest
from typer.testing import CliRunner

from fantwin.pipeline.cli import main as command_line
from fantwin.pipeline.cli.main import COMMANDS, PANELS, expand_variadic
from tests.support.running_chain import DEMO, fantwin

README = DEMO.parents[1] / "README.md"


@pytest.fixture(scope="module", autouse=True)
def _all_commands() -> None:
    registered = {command.name for command in command_line.app.registered_commands}
    command_line._register(name for name in COMMANDS if name not in registered)


def help_of(*words: str) -> str:
    result = CliRunner().invoke(command_line.app, [*words, "--help"], env={"COLUMNS": "200", "NO_COLOR": "1"})
    assert result.exit_code == 0
    return result.output


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_says_what_the_list_says_has_an_example_and_prints_json_if_asked(command: str) -> None:
    function = command_line.function_of(command)
    assert command_line.about(command).split() == str(getdoc(function)).partition("\n\n")[0].split()
    text = help_of(command)
    assert f"Example: fantwin {command}" in " ".join(text.split())
    assert "--json" in text


def test_the_version_is_that_of_the_project():
    result = CliRunner().invoke(command_line.app, ["--version"])
    declared = tomllib.loads((README.parent / "pyproject.toml").read_text())["project"]["version"]
    assert (result.exit_code, result.output) == (0, f"fantwin {declared}\n")


def test_help_lists_every_command_and_the_exit_codes():
    text = help_of()
    assert all(f" {command} " in text for command in COMMANDS)
    assert "Exit codes: 0 success" in text


def test_help_has_a_panel_for_each_folder_of_commands_in_order():
    folders = {path.name for path in Path(command_line.__file__).parent.iterdir() if (path / "__init__.py").exists()}
    assert set(PANELS) == folders == {module.split(".")[0] for module in COMMANDS.values()}
    lines = help_of().splitlines()
    panels = [next(n for n, line in enumerate(lines) if f" {panel} ─" in line) for panel in PANELS.values()]
    assert panels == sorted(panels)


LISTS = """
try:
    sys.argv = ["fantwin", "--help"]
    main.main()
except SystemExit:
    sys.argv = ["fantwin", "dmo"]
    try:
        main.main()
    finally:
        show()
"""
REGISTERS = """
main._register(["command"])
show()
main._register(["up"])
import fantwin.pipeline.cli.watch.one_stage
show()
main._register(["alarms", "status"])
show()
import fantwin.twin.build
show()
"""


def run(code: str) -> tuple[subprocess.CompletedProcess[str], list[set[str]]]:
    """A new process, and what it has imported whenever it shows that."""
    begin = "import sys\nfrom fantwin.pipeline.cli import main\ndef show(): print('imported', *sys.modules)\n"
    words = [sys.executable, "-c", begin + code]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert "Traceback" not in done.stderr
    return done, [{*line.split()} for line in done.stdout.splitlines() if line.startswith("imported")]


def of_commands(modules: set[str]) -> set[str]:
    return {each.removeprefix("fantwin.pipeline.cli.") for each in modules if each.startswith("fantwin.pipeline.cli.")}


def test_the_list_of_commands_imports_none_of_them_also_for_a_mistyped_one() -> None:
    done, (modules,) = run(LISTS)
    assert of_commands(modules) == {"main"}
    assert modules.isdisjoint(("numpy", "scipy"))
    assert done.returncode == 2 and "No such command 'dmo'" in done.stderr


def test_a_command_and_a_stage_import_nothing_but_what_they_need() -> None:
    """They are to start at once, and most of that time is imports."""
    _, (command, stage, beside, training) = run(REGISTERS)
    rooms = ("scoring", "stages", "twin", "pipeline.launch", "pipeline.runtime.stage")
    watching_and_judging = (*(f"fantwin.{room}" for room in rooms), "rich", "scipy", "onnxr")
    assert [name for name in command if name.startswith(watching_and_judging)] == []
    assert of_commands(stage) - of_commands(command) <= {"exposure", "main", "options", "watch.one_stage", "watch.up"}
    assert {"rich", "cryptography"}.isdisjoint(stage)
    assert {"cryptography", "scipy", "onnxruntime", "pandas", "matplotlib", "rerun", "torch"}.isdisjoint(beside)
    assert {"scipy.stats", "scipy.signal", "onnxruntime", "pandas", "matplotlib", "torch"}.isdisjoint(training)


INTERRUPTED_WHEN_IT_IMPORTS = """
import os, signal, sys
from fantwin.__main__ import main
class Interrupt:
    def find_spec(self, name, *_rest):
        if name == {module!r}:
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Interrupt())
sys.argv = ["fantwin", "up"]
main()
"""


@pytest.mark.parametrize("module", ["typer", "fantwin.pipeline.cli.watch.up"])
def test_ctrl_c_while_a_command_is_still_imported_ends_it_without_a_word(module: str) -> None:
    code = INTERRUPTED_WHEN_IT_IMPORTS.format(module=module)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (-signal.SIGINT, "", "")


def test_a_mistake_in_a_process_of_its_own_is_an_exit_code_and_no_traceback() -> None:
    done = fantwin("view", "none.mcap")
    assert (done.returncode, done.stdout) == (1, "")
    assert "fantwin: none.mcap: cannot read the recording: No such file or directory" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("words", "expanded"),
    [
        ("train A B --validate C D -o T", "train A B --validate C --validate D -o T"),
        ("train A --validate C D", "train A --validate C --validate D"),
        ("train A --validate C --validate D E", "train A --validate C --validate D --validate E"),
        ("train A --validate=C -o T", "train A --validate=C -o T"),
        ("train A --validate -o T", "train A --validate -o T"),
        ("train A -o T B", "train A -o T B"),
        ("evaluate T --validate A B", "evaluate T --validate A B"),
        ("", ""),
    ],
)
def test_a_variadic_option_takes_all_words_up_to_the_next_option(words, expanded):
    assert expand_variadic(words.split()) == expanded.split()


def test_row_15_a_lack_of_memory_is_one_line(monkeypatch, capsys):
    def fail(_: list[str]) -> None:
        raise MemoryError

    monkeypatch.setattr(command_line, "_register", lambda _: None)
    monkeypatch.setattr(command_line, "app", fail)
    monkeypatch.setattr(sys, "argv", ["fantwin", "import", "x.csv"])
    with pytest.raises(SystemExit) as ended:
        command_line.main()
    assert ended.value.code == 1
    assert capsys.readouterr().err == "fantwin: not enough memory for this; use smaller files, or a machine with more\n"


@pytest.mark.parametrize(
    ("line", "offered", "not_offered"),
    [
        ("fantwin al", {"alarms"}, {"up"}),
        ("fantwin alarms --hi", {"--history"}, {"--json"}),
        ("fantwin doctor --li", {"--listen-s"}, set()),
    ],
)
def test_a_shell_completes_commands_and_their_options(line, offered, not_offered) -> None:
    asked = {"_FANTWIN_COMPLETE": "complete_bash", "COMP_WORDS": line, "COMP_CWORD": str(len(line.split()) - 1)}
    program = "import sys; sys.argv = ['fantwin']; from fantwin.pipeline.cli.main import main; main()"
    command, environment = [sys.executable, "-c", program], {**os.environ, **asked}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60, check=True)
    found = set(done.stdout.split())
    assert offered <= found, done.stderr
    assert found.isdisjoint(not_offered)
