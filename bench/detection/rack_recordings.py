"""Recordings of simulated racks, as the recorder of a rack without a twin would have made them, kept in a folder."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

from bench.detection.plant import START_NS
from bench.detection.racks import DAY_S, TACHOS, Racks, fault_schedule, racks, reports, run_of
from fantwin.pipeline.recordings.reading import TACHO_KEY
from fantwin.pipeline.recordings.writing import RecordingWriter
from fantwin.schemas.header import Header
from fantwin.schemas.tacho import tachos_to_json
from fantwin.schemas.topics import tray_key
from fantwin.simulation.faults import Fault

SITE, TRAY, PRODUCER = "bench", "rack", "acquisition"
METADATA = {
    "made_by": "bench.detection",
    "source": "simulated rack",
    "site": SITE,
    "trays": TRAY,
    "speed_unit": "rpm",
    f"{TACHO_KEY}.{TRAY}": tachos_to_json(TACHOS),
}
SHORT_S, NIGHT_S = 300.0, 8 * 3600.0
SWEEP, HEALTHY, FAULTY = "sweep", "healthy", "faulty"
LEARNING = {
    "15 minutes": ("minutes", SHORT_S, 2),
    "one night": ("night", NIGHT_S, 1),
    "three nights": ("night", NIGHT_S, 3),
}
"""name, length and number of the recordings under the thermostat, besides five minutes of a sweep"""
SEEDS = {SWEEP: 100, "minutes": 200, "night": 300, "test": 400}
"""of the commands and chances, apart; the fans are the same in all"""


@dataclass(frozen=True)
class RackData:
    """The recordings of so many racks at one rate. test_s: length of the test, once without and once with faults.

    without: parts of the model that the racks are calibrated and judged without (bench.detection.without); what is made
    of the recordings is kept by their names.
    """

    folder: Path
    count: int
    rate_hz: float
    test_s: float = DAY_S
    seed: int = 0
    without: tuple[str, ...] = ()

    def kept_name(self, learning: str) -> str:
        """What the files are called that were made by an amount of learning."""
        return "-without-".join((learning.replace(" ", "-"), *self.without))

    def sweep(self, rack: int) -> Path:
        """The recording of a rack that its twin is trained on."""
        return self._path(SWEEP, rack)

    def learning(self, name: str, rack: int) -> list[Path]:
        """The recordings of a rack under its thermostat before the test. name: of LEARNING."""
        run, _, count = LEARNING[name]
        return [self._path(f"{run}{number + 1}", rack) for number in range(count)]

    def test(self, name: str, rack: int) -> Path:
        """The test of a rack. name: HEALTHY or FAULTY, the same commands and chances in both."""
        return self._path(f"{name}-{self.test_s:g}s", rack)

    def test_racks(self) -> Racks:
        """The racks in the test."""
        return racks(self.count, self.test_s, self.seed + SEEDS["test"])

    def faults(self) -> list[Fault]:
        """Those of the test, of all racks."""
        return fault_schedule(self.test_racks())

    def make(self, learning: Sequence[str], progress: Callable[[str], None]) -> None:
        """Write the recordings that are not there yet, with those that choose among the weights of a twin."""
        self._write(SWEEP, racks(self.count, SHORT_S, self.seed + SEEDS[SWEEP]), None, progress)
        for name in dict.fromkeys(("15 minutes", *learning)):
            run, seconds, count = LEARNING[name]
            for number in range(count):
                of = racks(self.count, seconds, self.seed + SEEDS[run] + number)
                self._write(f"{run}{number + 1}", of, None, progress)
        self._write(f"{HEALTHY}-{self.test_s:g}s", self.test_racks(), None, progress)
        self._write(f"{FAULTY}-{self.test_s:g}s", self.test_racks(), self.faults(), progress)

    def _path(self, run: str, rack: int) -> Path:
        place = self.folder / f"{self.count}racks-seed{self.seed}-{self.rate_hz:g}Hz" / run_of(rack)
        return place / f"{run}.mcap"

    def _write(self, run: str, of: Racks, faults: list[Fault] | None, progress: Callable[[str], None]) -> None:
        paths = [self._path(run, rack) for rack in range(self.count)]
        if all(path.exists() for path in paths):
            return
        progress(f"{run}: {self.count} racks for {of.seconds / 3600:.3g} h at {self.rate_hz:g} Hz")
        key, unfinished = tray_key(SITE, TRAY, "raw"), [path.with_suffix(".part.mcap") for path in paths]
        with ExitStack() as open_files:
            writers = []
            for path in unfinished:
                path.parent.mkdir(parents=True, exist_ok=True)
                writers.append(open_files.enter_context(RecordingWriter(path, METADATA, t_ns=START_NS, overwrite=True)))
            sent = [0] * self.count
            for blocks in reports(of, self.rate_hz, faults, is_swept=run == SWEEP):
                for rack, raw in enumerate(blocks):
                    if not len(raw.host_receive_t_ns):
                        continue
                    message = replace(raw, header=Header(PRODUCER, sent[rack], TRAY))
                    writers[rack].add_message(key, message, int(raw.host_receive_t_ns[-1]))
                    sent[rack] += 1
        for path, made in zip(paths, unfinished, strict=True):
            made.replace(path)
