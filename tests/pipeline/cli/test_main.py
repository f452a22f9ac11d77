"""The command line: every command explains itself, and every mistake is one line and an exit code."""

from __future__ import annotations

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


def modules_after(code: str) -> set[str]:
    """What a new process has imported after this, and must have ended with nothing worse than SystemExit."""
    show = "finally: print('\\n' + ' '.join(sys.modules))"
    done = subprocess.run(
        [sys.executable, "-c", f"import sys\nfrom fantwin.pipeline.cli import main\ntry: {code}\n{show}"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert "Traceback" not in done.stderr
    return set(done.stdout.splitlines()[-1].split())


@pytest.mark.parametrize("words", ["--help", "dmo"])
def test_the_list_of_commands_imports_none_of_them(words: str) -> None:
    modules = modules_after(f"sys.argv = ['fantwin', '{words}']; main.main()")
    assert {m for m in modules if m in ("numpy", "scipy") or m.startswith("fantwin.pipeline.cli.")} == {
        "fantwin.pipeline.cli.main"
    }


def test_the_process_of_a_stage_imports_no_rich_and_no_other_command() -> None:
    modules = modules_after("main._register(['up']); import fantwin.pipeline.cli.watch.one_stage")
    assert {m for m in modules if m == "rich" or m.startswith(("rich.", "fantwin.pipeline.cli."))} == {
        *("fantwin.pipeline.cli.exposure", "fantwin.pipeline.cli.main", "fantwin.pipeline.cli.options"),
        *("fantwin.pipeline.cli.watch", "fantwin.pipeline.cli.watch.one_stage", "fantwin.pipeline.cli.watch.up"),
    }


def test_commands_beside_a_running_site_import_nothing_that_is_slow() -> None:
    modules = modules_after("main._register(['alarms', 'command', 'status', 'up'])")
    assert {"scipy", "onnxruntime", "pandas", "matplotlib", "rerun", "torch"}.isdisjoint(modules)


def test_a_command_imports_nothing_that_only_watching_and_judging_need() -> None:
    """It is to be answered at once, and most of its time is imports."""
    rooms = ("scoring", "stages", "twin", "pipeline.launch", "pipeline.runtime.stage")
    unneeded = (*(f"fantwin.{room}" for room in rooms), "rich", "scipy", "onnxr")
    assert [name for name in modules_after("main._register(['command'])") if name.startswith(unneeded)] == []


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


@pytest.mark.parametrize("module", ["typer", "fantwin.pipeline.cli.main", "fantwin.pipeline.cli.watch.up"])
def test_ctrl_c_while_a_command_is_still_imported_ends_it_without_a_word(module: str) -> None:
    code = INTERRUPTED_WHEN_IT_IMPORTS.format(module=module)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (-signal.SIGINT, "", "")


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        ("view none.mcap", 1, "fantwin: none.mcap: cannot read the recording: No such file or directory"),
        ("vieww", 2, "No such command 'vieww'"),
    ],
)
def test_a_mistake_in_a_process_of_its_own_is_an_exit_code_and_no_traceback(words: str, code: int, said: str) -> None:
    done = fantwin(*words.split())
    assert (done.returncode, done.stdout) == (code, "")
    assert said in done.stderr and "Traceback" not in done.stderr


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
