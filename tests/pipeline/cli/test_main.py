"""The command line: every command explains itself, and every mistake is one line and an exit code."""

from __future__ import annotations

import ast
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Sequence
from importlib import import_module
from inspect import getdoc
from pathlib import Path

import pytest
from typer.testing import CliRunner

from pipeline.cli import main as command_line
from pipeline.cli.main import COMMANDS, PANELS, expand_variadic
from tests.support.running_chain import DEMO, fantwin

CONFIG = DEMO / "demo.toml"
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
def test_every_command_has_an_example_and_prints_json_if_asked(command):
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
    assert set(PANELS) == folders == {module.split(".")[0] for module, _ in COMMANDS.values()}
    lines = help_of().splitlines()
    panels = [next(n for n, line in enumerate(lines) if f" {panel} ─" in line) for panel in PANELS.values()]
    assert panels == sorted(panels)


def test_the_list_of_commands_says_what_the_first_paragraph_of_each_help_says_and_imports_none_of_them():
    for name, (module, about) in COMMANDS.items():
        function = getattr(import_module(f"pipeline.cli.{module}"), module.rpartition(".")[2])
        assert about.split() == str(getdoc(function)).partition("\n\n")[0].split(), name
    for words in ("--help", "--version", "dmo", ""):
        look = f"import sys; from pipeline.cli import main; sys.argv = ['fantwin', *'{words}'.split()]"
        show = "print(*(m for m in sys.modules if m in ('numpy', 'scipy') or m.startswith('pipeline.cli.')))"
        code = f"{look}\ntry: main.main()\nfinally: {show}"
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
        assert done.stdout.endswith("pipeline.cli.main\n"), words
        assert "demo" in done.stdout + done.stderr or words == "--version"


def test_the_process_of_a_stage_imports_no_rich_and_no_other_command():
    look = (
        "import sys; from pipeline.cli import main; main._register(['run']);"
        "print([m for m in sys.modules if m == 'rich' or m.startswith(('rich.', 'pipeline.cli.'))])"
    )
    done = subprocess.run([sys.executable, "-c", look], capture_output=True, text=True, check=True)
    assert set(ast.literal_eval(done.stdout)) == {
        *("pipeline.cli.exposure", "pipeline.cli.main", "pipeline.cli.options"),
        *("pipeline.cli.watch", "pipeline.cli.watch.run"),
    }


@pytest.mark.parametrize("command", ["alarms", "command", "status", "up"])
def test_a_command_beside_a_running_site_imports_nothing_that_is_slow(command: str):
    look = (
        f"import sys; from pipeline.cli import main; main._register(['{command}']);"
        "print(sorted({'scipy', 'onnxruntime', 'pandas', 'matplotlib', 'rerun', 'torch'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", look], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recorded") / "tray.mcap"
    assert fantwin("simulate", "--fans", 1, "--duration", 2, "--recording", path).returncode == 0
    return path


def assert_one_line(done: subprocess.CompletedProcess[str], code: int, words: Sequence[str]) -> None:
    assert done.returncode == code, done.stderr
    assert done.stderr.startswith("fantwin: ")
    assert done.stderr.count("\n") == 1, done.stderr
    assert done.stdout == ""
    for word in words:
        assert word in done.stderr


@pytest.mark.parametrize(
    ("command", "words"),
    [
        ("up -c none.toml", ["none.toml", "cannot read the configuration", "-c FILE"]),
        (f"run scorer -c {CONFIG} --set scorer.on_dealy_s=1", ["scorer.on_dealy_s", "did you mean 'on_delay_s'"]),
        (f"run acquisition -c {CONFIG} --set tray.0.port=''", ["port is missing", "/dev/ttyUSB0"]),
        (f"run twin_integrator -c {CONFIG} --set tray.0.twin=none.onnx", ["none.onnx", "correct [[tray]] twin"]),
        (f"run twin_integrator -c {CONFIG} --set tray.0.fans=3", ["a twin of 8 fans", "choose a twin that fits"]),
        (f"run scorer -c {CONFIG} --set bus.endpoint=nowhere", ["bus.endpoint = 'nowhere'", "<protocol>/<address>"]),
        ("router --listen nowhere", ["'nowhere'", "<protocol>/<address>"]),
        ("plot none.mcap", ["none.mcap", "cannot read the recording"]),
        (f"plot {README}", ["not a recording", "fantwin import"]),
        ("train none.mcap -o twin.onnx", ["none.mcap", "cannot read the recording"]),
        (f"evaluate {DEMO / 'twin.onnx'} {README}", ["not a recording"]),
        ("picture none.rrd", ["none.rrd", "no such file"]),
        ("import none.csv --time t:s --command u --speed y:rpm -o x.mcap", ["none.csv", "cannot be read"]),
        ("demo -o /proc/demo", ["/proc/demo", "name another with -o"]),
    ],
)
def test_a_mistake_is_one_line_with_what_to_do(command, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert_one_line(fantwin(*command.split()), 1, words)


@pytest.mark.parametrize(
    ("command", "words"),
    [
        ("alarms CONFIG --for 5m", "--for, --comment, --operator and --onset need an action"),
        ("alarms shelve tray1 3 CONFIG --for soon", "--for soon: give a time such as 90s"),
        ("alarms ack tray1 9 CONFIG", "fan 9: tray tray1 has fans 0 to 7"),
        ("calibrate TWIN RECORDING", "declare a rate: --false-alarms-per-day"),
        ("calibrate TWIN RECORDING RECORDING --false-alarms-per-day 1", "named twice"),
        ("command CONFIG --fan 9 0.5", "--fan 9: tray tray1 has fans 0 to 7"),
        ("command CONFIG --fan 0 2", "--fan 0 2: the command must be within 0 to 1"),
        ("commission CONFIG --set tray.0.twin=a --tray nobody", "no tray called 'nobody'; known: tray1"),
        ("compare RECORDING --model spline", "--model spline: no such model"),
        ("evaluate TWIN RECORDING --rate fast", "--rate fast: give a rate in Hz"),
        ("evaluate TWIN RECORDING --fans 3,1", "--fans 3,1: give each fan once"),
        ("export RECORDING --to csv -o table.parquet", "table.parquet: name a file that ends in .csv"),
        ("identify RECORDING --window -1", "--window: "),
        ("import x.csv --time t --period 1s --command u --speed y -o y.mcap", "leave out --time or --period"),
        ("import x.csv --time t --command u --speed y -o y.mcap --tray a/b", "--tray a/b: use letters"),
        ("learn TRAYS", "choose one with --tray: a, b"),
        ("plot RECORDING --unit mph", "--unit mph: no such unit"),
        ("replay RECORDING --rate quick", "--rate quick: give a number above 0"),
        ("run scorr CONFIG", "no stage called 'scorr'; known: acquisition"),
        ("run acquisition CONFIG --tray nobody", "no tray called 'nobody'"),
        ("selftest kil", "no scenario 'kil'"),
        ("simulate --fans 99", "fans = 99; give one from 1 to 64"),
        ("simulate --fault melt:fan=1", "melt"),
        ("simulate --recording x.mcap", "--recording needs --duration"),
        ("simulate --tacho count --window -1", "--window -1.0: "),
        ("sweep CONFIG --safe 2", "--safe 2: the command must be within 0 to 1"),
        ("sweep CONFIG --low 0.9 --high 0.1", "--low 0.9 --high 0.1: name a range"),
        ("sweep TRAYS", "name the tray with --tray (trays: a, b)"),
        ("train RECORDING -o twin.bin", "twin.bin: name a file that ends in .onnx"),
        ("twins TRAYS --tray a --faulty-from 2026-11-24", "give --faulty-from and --faulty-to"),
        ("twins TRAYS --tray a --faulty-from 2026-11-24 --faulty-to then", "--faulty-to then: not a time"),
        ("up CONFIG --set scorer", "--set scorer: write KEY=VALUE"),
    ],
)
def test_a_wrong_option_is_one_line_and_wrong_usage(
    command: str,
    words: str,
    recording: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    trays = tmp_path / "trays.toml"
    trays.write_text("".join(f'[[tray]]\nname = "{name}"\nfans = 1\nport = "{name}"\n' for name in "ab"))
    (tmp_path / "x.csv").write_text("t,u,y\n0,1,2\n")
    stand_for = {
        "RECORDING": [recording],
        "TWIN": [DEMO / "twin.onnx"],
        "CONFIG": ["-c", CONFIG],
        "TRAYS": ["-c", trays],
    }
    arguments = [str(each) for word in command.split() for each in stand_for.get(word, [word])]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(command_line, "_register", lambda _: None)  # they are registered already
    monkeypatch.setattr(sys, "argv", ["fantwin", *arguments])
    with pytest.raises(SystemExit) as ended:
        command_line.main()
    printed = capsys.readouterr()
    assert ended.value.code == 2, printed.err
    assert words in printed.err
    assert printed.err.startswith("fantwin: ")
    assert printed.err.count("\n") == 1
    assert printed.out == ""


def test_wrong_usage_has_its_own_exit_code():
    done = fantwin("plott")
    assert done.returncode == 2
    assert "No such command" in done.stderr
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


def test_train_takes_every_recording_after_validate_as_one_to_judge_by(recording, tmp_path):
    twin = tmp_path / "twin.onnx"
    other = shutil.copy(recording, tmp_path / "other.mcap")
    words = ["train", recording, "--model", "physical", "--validate", other, "none.mcap", "-o", twin]
    refused = fantwin(*words)
    assert refused.returncode == 1
    assert refused.stderr.splitlines()[-1].startswith("fantwin: none.mcap: cannot read the recording")
    words[6] = other
    done = fantwin(*words, "--json")
    assert done.returncode == 0, done.stderr
    assert '"evaluated_on": "held-out"' in done.stdout


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
