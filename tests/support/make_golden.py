"""Makes the golden recordings in tests/support/data again: python -m tests.support.make_golden

Of golden.mcap: a real site watches a simulated tray of two fans for some ten seconds; one inlet is covered and
uncovered, its alarm is acknowledged, that of the other fan is shelved, and the twin integrator and the scorer are
killed on the way, so that the scorer continues from its snapshot. The twin is a physical one, which needs no function
whose last bit depends on the machine, and its alarms are calibrated.

Of golden-restart.mcap: a site without processes. An alarm is acknowledged, a fan shelved and another one taken out of
service; then the scorer is killed and continues from its snapshot.

Make them again only when what the stages decide, or a format, is meant to change, and say why in the commit. It takes
some minutes.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parents[2]), str(Path(__file__).parent)]

from fantwin.pipeline.recordings.reading import read_metadata, read_recording  # noqa: E402
from fantwin.pipeline.recordings.writing import RecordingWriter  # noqa: E402
from fantwin.schemas.enums import Action  # noqa: E402
from tests.support.killed_site import Site  # noqa: E402
from tests.support.ports import free_port  # noqa: E402
from tests.support.running_chain import TRAY, Chain, eventually, fantwin, published, view_of  # noqa: E402

DATA = Path(__file__).parent / "data"
FANS, FAULTY = 2, 1
CONFIGURATION = f"""
site = "demo"
[[tray]]
name = "{TRAY}"
fans = {FANS}
speed_unit = "rpm"
speed_max = 20000
twin = "twin.onnx"
[resampler]
rate_hz = 50
[twin_integrator]
warm_up_s = 1.0
[scorer]
alarm_share = 0.2
"""


def main() -> None:
    """Make both."""
    DATA.mkdir(exist_ok=True)
    make_golden(DATA / "golden.mcap")
    make_golden_restart(DATA / "golden-restart.mcap")
    for path in DATA.glob("golden*.mcap"):
        print(f"{path}: {path.stat().st_size} bytes")


def make_golden(path: Path) -> None:
    """Train a twin, run the site, kill two stages, and keep the recording."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        healthy = folder / "healthy.mcap"
        run(
            *("simulate", "--fans", FANS, "--set", "rate_hz=50", "--profile", "multisine"),
            *("--duration", 120, "--recording", healthy),
        )
        run("train", healthy, "--model", "physical", "--name", "golden", "-o", folder / "twin.onnx")
        run("calibrate", folder / "twin.onnx", healthy, "--false-alarms-per-day", 24, "--extrapolate")
        (folder / "golden.toml").write_text(CONFIGURATION)
        chain = Chain(folder, f"tcp/127.0.0.1:{free_port()}", configuration=folder / "golden.toml")
        try:
            record(chain)
        finally:
            chain.close()
        (recording,) = chain.recordings()
        keep(recording, path)


def make_golden_restart(path: Path) -> None:
    """Kill a scorer while its operators have set something for each fan."""
    with tempfile.TemporaryDirectory() as name:
        site = Site(Path(name), seed=1)
        site.run(200)
        site.ask(Action.ACKNOWLEDGE, fan=0)
        site.ask(Action.SHELVE, fan=1, duration_s=60.0)
        site.ask(Action.OUT_OF_SERVICE, fan=2)
        site.run(10)
        site.kill("scorer")
        site.run(100)
        path.write_bytes(site.finished().read_bytes())


def record(chain: Chain) -> None:
    """Some ten seconds with a fault and two killed stages."""
    tray = chain.start_tray("--fans", str(FANS), "--fault", f"inlet:fan={FAULTY},start=3,stop=9,size=2.0")
    up = chain.start_up()
    with chain.watcher() as watcher:
        eventually(lambda: published(view_of(watcher, "scorer")) > 100, "scores flow")
        chain.kill(watcher, "twin_integrator")
        eventually(
            lambda: any(each.newest.fan == FAULTY and each.newest.active for each in watcher.current_alarms()),
            "it is raised",
        )
        run(*chain.words("alarms"), "acknowledge", TRAY, FAULTY, "--operator", "Ann")
        run(*chain.words("alarms"), "shelve", TRAY, 1 - FAULTY, "--for", "1m", "--operator", "Bob")
        chain.kill(watcher, "scorer")
        eventually(lambda: not any(each.newest.active for each in watcher.current_alarms()), "it is cleared")
    assert tray.end() == 0
    assert up.end() == 0, up.output()


def keep(recording: Path, path: Path) -> None:
    """Write the golden recording: all decisions and their input, without health, ports and folders of the machine."""
    head = read_metadata(recording)
    metadata = {key: value for key, value in head.metadata.items() if key != "overrides"}
    with RecordingWriter(path, metadata, head.attachments, overwrite=True) as writer:
        for entry in read_recording(recording):
            if entry.topic != "health":
                writer.add_message(entry.key, entry.message, entry.received_t_ns)


def run(*words: object) -> None:
    """A command that must succeed."""
    result = fantwin(*words, timeout_s=600)
    assert result.returncode == 0, result.stderr


if __name__ == "__main__":
    main()
