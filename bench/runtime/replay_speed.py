"""How fast a recording is scored again offline: multiples of real time, and messages a second beside bare `mcap`.

Ten minutes of eight fans at 100 Hz, one sample a message, as the stages on a bus leave them: written here by the cores
of the stages, message by message. The library reads the same file and decodes nothing.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer
from mcap.reader import make_reader

from bench.printing import JsonOption, progress, show

sys.path.insert(0, str(Path(__file__).parents[2]))

from fantwin.pipeline.config.loading import load_config
from fantwin.pipeline.recordings.reading import read_recording
from fantwin.pipeline.replay.offline.replay_input import open_replay_input
from fantwin.pipeline.replay.offline.rescoring import rescore
from fantwin.schemas.blocks import cut
from fantwin.schemas.messages import Raw
from tests.support.killed_site import Stages
from tests.support.running_chain import DEMO, fantwin


def main(
    minutes: Annotated[float, typer.Option(help="Length of the recording.")] = 10.0,
    json_output: JsonOption = False,
) -> None:
    """Print how long reading, scoring and verifying take, as ratios."""
    with tempfile.TemporaryDirectory() as folder:
        progress(f"making a recording of {minutes:g} min")
        path = recording(Path(folder), 60 * minutes)
        messages = 0

        def read() -> None:
            nonlocal messages
            with path.open("rb") as file:
                messages = sum(1 for _ in make_reader(file).iter_messages(log_time_order=False))

        rows = []
        bare_s = timed(read)
        ways: list[tuple[str, Callable[[], object]]] = [
            ("fantwin replay --offline", lambda: rescored(path, None, verify=False)),
            ("the same, --verify", lambda: rescored(path, None, verify=True)),
            ("the same, -o OUT.mcap", lambda: rescored(path, Path(folder) / "out.mcap", verify=False)),
        ]
        rows.append(row("bare mcap reading", bare_s, minutes, messages, bare_s))
        for name, way in ways:
            progress(name)
            rows.append(row(name, timed(way), minutes, messages, bare_s))
        notes = [f"{messages} messages, {path.stat().st_size / 2**20:.0f} MiB; without the start of Python"]
        show({"scoring a recording again": rows}, notes, as_json=json_output)


def row(name: str, took_s: float, minutes: float, messages: int, bare_s: float) -> dict[str, Any]:
    """The row of one way to replay: its time and rates."""
    return {
        "way": name,
        "s": took_s,
        "times real time": 60 * minutes / took_s,
        "messages a second": round(messages / took_s),
        "of the bare library": bare_s / took_s,
    }


def timed(work: Callable[[], object]) -> float:
    """Seconds that `work` takes."""
    began_s = time.perf_counter()
    work()
    return time.perf_counter() - began_s


def rescored(path: Path, output: Path | None, *, verify: bool) -> None:
    """Replay offline; with `verify`, assert that the result equals the recording."""
    with open_replay_input([path], None, (), None) as material:
        (tray,) = rescore(material, output, verify)
    assert tray.comparison is None or tray.comparison.is_equal, tray.comparison


def recording(folder: Path, seconds: float) -> Path:
    """The recording of a site that watches the tray of the demo for `seconds`, with a fault every two minutes."""
    recording = folder / "raw.mcap"
    faults = [
        w
        for start in range(60, int(seconds), 120)
        for w in ("--fault", f"inlet:fan=2,start={start},stop={start + 10},size=1.8")
    ]
    done = fantwin(
        *(
            "simulate",
            "--fans",
            8,
            "--set",
            "speed_unit=rpm",
            "--duration",
            seconds,
            "--set",
            f"epoch_ns={10**18}",
            *faults,
        ),
        *("--recording", recording),
        timeout_s=600,
    )
    assert done.returncode == 0, done.stderr
    path = folder / "recording.mcap"
    site = shutil.copytree(DEMO, folder / "site")  # its stages leave files there
    stages = Stages(load_config(site / "demo.toml"), path, 10**18)
    for entry in read_recording(recording):
        assert isinstance(entry.message, Raw)
        for k, t_ns in enumerate(entry.message.host_receive_t_ns.tolist()):
            stages.now_ns = t_ns
            stages.take(cut(entry.message, k, k + 1))
            stages.tick()
    stages.end()
    return path


if __name__ == "__main__":
    typer.run(main)
