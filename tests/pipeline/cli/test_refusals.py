"""What each command refuses: the exit code, one line that says what to do, nothing written. The list: refusals.txt."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from fantwin.pipeline.cli import main as command_line
from fantwin.pipeline.cli.main import COMMANDS
from fantwin.twin.models.physical import PhysicalModel
from fantwin.twin.runs import Run
from tests.support.fan_data import published_run
from tests.support.running_chain import DEMO
from tests.support.score_data import made_up_tray
from tests.support.small_recordings import write
from tests.support.twin_files import write_twin
from tests.support.written_logs import write_ulog
from tests.support.written_recordings import write_run

LINES = Path(__file__).with_name("refusals.txt").read_text(encoding="utf-8").splitlines()
ROWS = [line for line in LINES if line and not line.startswith("#")]
REFUSALS = [
    (words.removeprefix("$ fantwin "), *refusal.split(maxsplit=1))
    for words, refusal in zip(ROWS[::2], ROWS[1::2], strict=True)
]

GOLDEN = Path(__file__).parents[2] / "support" / "data" / "golden.mcap"
TRAYS = ("tray1", "tray2")
ESCS = ("uint64_t timestamp;esc_report[2] esc;", [(1000 * k, 3000, 12.0, 3000, 12.0) for k in range(3)])

TABLES = {
    "bare.csv": "u,y1\n1,2\n2,3\n",
    "again.csv": "t,u,y1,y2\n0,1,2,2\n1,2,3,4\n",
    "open-date.csv": "Time,u,y1\n06/09/2026 21:59:50,1,2\n06/09/2026 21:59:51,2,3\n",
    "open-mark.csv": "t;u;y1\n0;1;1.016\n1;2;1.018\n",
    "zone.csv": "Time,u,y1\n09-Jun-2026 21:59:50 CST,1,2\n09-Jun-2026 21:59:51 CST,2,3\n",
    "set-back.csv": "Time,u,y1\n" + "".join(f"2026-10-25 0{2 - (k > 19)}:00:{k:02},1,2\n" for k in range(40)),
    "long.csv": "Series;Time;Value\n" + "".join(f"{of};{k};{k + 1}\n" for of in ("fan1", "pwm1") for k in range(5)),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files that the refusals name: those of a site, recordings, twins, and some that are none."""
    folder = tmp_path_factory.mktemp("refused")
    demo = (DEMO / "demo.toml").read_text(encoding="utf-8")
    (folder / "fantwin.toml").write_text(demo.replace("../../runs/by-hand", "runs"), encoding="utf-8")
    shutil.copy(DEMO / "twin.onnx", folder)
    tray = '[[tray]]\nname = "{0}"\nfans = 1\nport = "{0}"\n'
    (folder / "trays.toml").write_text(tray.format("a") + tray.format("b"), encoding="utf-8")
    (folder / "plain.toml").write_text('[[tray]]\nname = "tray1"\nfans = 1\n', encoding="utf-8")
    (folder / "named.toml").write_text('[[tray]]\nname = "tray1"\nfans = ["CPU", "GPU"]\n', encoding="utf-8")
    (folder / "users.toml").write_text(tray.format("a") + '[gateway]\nusers = "none.toml"\n', encoding="utf-8")
    (folder / "table.csv").write_text("t,u,y1,y2\n0,1,2,2\n1,2,3,4\n2,2,2,2\n3,2,2,2\n", encoding="utf-8")
    for name, text in TABLES.items():
        (folder / name).write_text(text, encoding="utf-8")
    run = published_run(1, 20.0, fans=2)
    write_run(folder / "r.mcap", run)
    write_run(folder / "rpm.mcap", published_run(2, 20.0, fans=2), unit="rpm")
    write_run(folder / "three.mcap", published_run(3, 20.0, fans=3))
    write_run(folder / "still.mcap", Run("still", run.t_s, np.full_like(run.command, 50.0), run.speed_rad_s))
    training = {"trainer": "none", "physics": "fixed", "seed": 0, "iterations": 0, "duration_s": 0.0, "data": []}
    write_twin(folder / "two.onnx", PhysicalModel(), 2)
    write_twin(folder / "of-0-2.onnx", PhysicalModel(), 2, training=training | {"fans": [0, 2]})
    for name, content in (("bad.mcap", b"t,u,y\n"), ("magic.mcap", b"\x89MCAP0\r\n"), ("bad.onnx", b"nothing")):
        (folder / name).write_bytes(content)
    (folder / "kept.toml").write_text(tray.format("a") + tray.format("kept"), encoding="utf-8")
    for name in ("kept.onnx", "kept.rrd", "kept.csv"):
        (folder / name).write_bytes(b"kept")
    for name in ("folder", "bag"):
        (folder / name).mkdir()
    (folder / "bag" / "metadata.yaml").write_text("none", encoding="utf-8")
    shutil.copy(GOLDEN, folder)
    write(folder / "scores.mcap", [score for tray in TRAYS for score in made_up_tray(seconds=1, tray=tray)[0]])
    outputs = ("uint64_t timestamp;float[4] output;", [(1000 * k, *[0.5] * 4) for k in range(3)])
    write_ulog(folder / "flight.ulg", {"actuator_outputs": outputs, "esc_status": ESCS})
    (folder / "cut.ulg").write_bytes((folder / "flight.ulg").read_bytes()[:20])
    nested = {f"f{depth}": (f"f{depth + 1}[10] a;", ()) for depth in range(12)}
    write_ulog(folder / "nested.ulg", {**nested, "f12": ("float a;", ())})
    write_ulog(folder / "endless.ulg", {"a": ("b[2] x;", ()), "b": ("a y;", ())})
    return folder


def contents(folder: Path) -> dict[Path, bytes]:
    """Contents of all files but those of the run folder, where a command may leave a lock."""
    files = [path for path in folder.rglob("*") if path.is_file()]
    return {path: path.read_bytes() for path in files if "runs" not in path.relative_to(folder).parts}


def called(words: str, monkeypatch: pytest.MonkeyPatch) -> int:
    """The exit code of `fantwin words`, in this process, with that one command registered as in a new process."""
    monkeypatch.setattr(command_line.app, "registered_commands", [])
    monkeypatch.setattr(sys, "argv", ["fantwin", *words.split()])
    with pytest.raises(SystemExit) as ended:
        command_line.main()
    assert isinstance(ended.value.code, int)
    return ended.value.code


@pytest.mark.parametrize(("words", "code", "line"), REFUSALS, ids=[words for words, *_ in REFUSALS])
def test_a_command_that_cannot_be_carried_out_is_one_line_and_an_exit_code_and_writes_nothing(
    words: str,
    code: str,
    line: str,
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(folder)
    before = contents(folder)
    exit_code = called(words, monkeypatch)
    printed = capfd.readouterr()
    *progress, said = printed.err.splitlines()
    assert (f"{exit_code}", said.replace(str(folder), "FOLDER")) == (code, line)
    assert all(each.startswith(("reading", "drawing", "opening", "learning")) for each in progress), progress
    assert printed.out == ""
    assert contents(folder) == before


def test_every_command_that_takes_words_refuses_some() -> None:
    assert {words.split()[0] for words, *_ in REFUSALS} == set(COMMANDS)
