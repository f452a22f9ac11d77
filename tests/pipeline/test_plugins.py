"""A package of others adds a kind of source and an output, and nothing here knows of it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from fantwin.pipeline.config.loading import File
from fantwin.pipeline.config.registry import RESERVED, why_no_output
from fantwin.pipeline.config.settings import OWN_ROLES
from fantwin.pipeline.plugins import StageRow
from tests.support.built_wheel import unpacked_wheel
from tests.support.running_chain import RunningCommand, eventually

PROJECT = """
[project]
name = "toy-fan"
version = "1.0"
[project.entry-points."fantwin.sources"]
toy = "toy_fan:KIND"
serial = "toy_fan:KIND"
broken = "toy_fan_broken:KIND"
[project.entry-points."fantwin.outputs"]
toy_log = "toy_fan:ROW"
toy_pager = "toy_fan_broken:PAGER"
[tool.setuptools]
py-modules = ["toy_fan", "toy_fan_source", "toy_fan_log", "toy_fan_broken"]
"""
ROWS = """
from fantwin.pipeline.plugins import StageRow
from fantwin.pipeline.plugins import SourceKind
KIND = SourceKind("toy_fan_source:ToyConfig", "toy_fan_source:ToySource")
ROW = StageRow("toy_log", "toy_fan_log:STAGE", reads=("raw",))
"""
SOURCE = """
import threading
from typing import Literal
from fantwin.pipeline.sources.source import LinkUp, Reading, ReadingBatch, SourceConfig
from fantwin.pipeline.timebase.host_clock import HOST_CLOCK

class ToyConfig(SourceConfig, frozen=True):
    kind: Literal["toy"] = "toy"
    speed: float

class ToySource:
    name, settings_to_check = "toy", "speed"

    def __init__(self, config, context):
        self.speed, self.fans, self.stopped = config.speed, context.fans, threading.Event()
        self.thread = threading.Thread(target=self.run)

    def start(self, deliver):
        self.deliver = deliver
        deliver(LinkUp())
        self.thread.start()

    def run(self):
        number = 0
        while not self.stopped.wait(0.05):
            one = Reading((0.5,) * self.fans, (self.speed,) * self.fans, sequence=number)
            self.deliver(ReadingBatch(HOST_CLOCK.now_ns(), (one,)))
            number += 1

    def stop(self):
        self.stopped.set()
        self.thread.join()

    def send(self, command, set_point):
        return ""

    def check(self):
        return []
"""
OUTPUT = """
import json
from pathlib import Path
from fantwin.pipeline.runtime.stage import BuiltStage, Core, Stage, StageConfig
from toy_fan import ROW

class ToyLogConfig(StageConfig):
    file: Path

class ToyLog(Core):
    def __init__(self, path):
        self.path = path

    def step(self, item):
        self.path.write_text(json.dumps({"tray": item.header.tray, "speeds": item.speed_rad_s.tolist()[-1]}))
        return ()

STAGE = Stage(
    row=ROW, about="writes the newest speeds", config=ToyLogConfig,
    build=lambda context: BuiltStage(ToyLog(context.resolve(context.config.file))), core_per_tray=False,
)
"""
CONFIGURATION = """
[bus]
endpoint = "{endpoint}"
[launcher]
stages = ["acquisition", "toy_log"]
[[tray]]
name = "bench"
fans = 2
speed_unit = "rad/s"
source = {{ kind = "toy", speed = 123.0 }}
[toy_log]
file = "newest.json"
[toy_pager]
number = "112"
"""


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of an installed package, which the processes of fantwin see as they see site-packages."""
    source = tmp_path / "toy-fan"
    source.mkdir()
    files = {"pyproject.toml": PROJECT, "toy_fan.py": ROWS, "toy_fan_source.py": SOURCE, "toy_fan_log.py": OUTPUT}
    for name, text in {**files, "toy_fan_broken.py": "raise SystemExit('needs python 4')\n"}.items():
        (source / name).write_text(text)
    monkeypatch.setenv("PYTHONPATH", str(unpacked_wheel(source, tmp_path)), prepend=":")
    return tmp_path


def test_a_source_and_an_output_of_another_package_run_and_what_is_broken_is_left_out_with_a_line(installed, endpoint):
    (installed / "fantwin.toml").write_text(CONFIGURATION.format(endpoint=endpoint))
    newest = installed / "newest.json"
    up = RunningCommand(["up", "-c", installed / "fantwin.toml"])
    try:
        assert eventually(newest.exists, "samples of the source have reached the output")
        assert up.end() == 0, up.lines
    finally:
        up.process.kill()
    assert json.loads(newest.read_text()) == {"tray": "bench", "speeds": [123.0, 123.0]}
    said = {line for line in up.lines if "is left out" in line}
    assert {
        "fantwin.sources 'serial' is left out: this name is taken; correct or uninstall the package toy-fan",
        "fantwin.sources 'broken' is left out: SystemExit: needs python 4; correct or uninstall the package toy-fan",
    } <= said


def test_no_stage_may_have_the_name_of_a_key_or_a_role():
    assert {*File.model_fields, *OWN_ROLES} == RESERVED


@pytest.mark.parametrize(
    ("row", "why"),
    [
        (StageRow("pager", "x:STAGE", reads=("alarm",), writes=("request",)), ""),
        (StageRow("pagr", "x:STAGE"), "its row is called 'pagr'"),
        (StageRow("pager", "x:STAGE", reads=("temperature",)), "its row reads or writes another topic than alarm, "),
        (StageRow("pager", "x:STAGE", writes=("command",)), "it may write requests and nothing else"),
        (StageRow("pager", "x:STAGE", enabled_by="default"), "only a section"),
        (StageRow("pager", "x:STAGE", scope="tray"), "only a section"),
    ],
)
def test_a_row_that_would_harm_the_plant_is_refused_with_the_reason(row, why):
    assert why_no_output("pager", row).startswith(why) and bool(why_no_output("pager", row)) == bool(why)


@pytest.mark.parametrize("name", ["bus", "operator", "acquisition.bench", "Pager"])
def test_nor_may_it_have_the_name_of_something_else(name):
    assert why_no_output(name, StageRow(name, "x:STAGE")) == "a stage may not have this name"
