"""A recorder that is killed repeatedly under load; its recording is compared with what was sent."""

from __future__ import annotations

import json
import random
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from mcap.reader import make_reader

from bench.runtime.recorder_feed import PRODUCER, SITE, TOPICS
from fantwin.pipeline.recordings.contents import contents_of
from fantwin.pipeline.recordings.reading import RecordingError, read_recording
from fantwin.pipeline.recordings.scan import Contents, scan
from fantwin.schemas.enums import StageStatus
from tests.support.running_chain import DEADLINE_S, FANTWIN, eventually


@dataclass
class Outcome:
    """The state of a recording after all kills."""

    kills: int
    parts: int = 0
    unreadable: list[str] = field(default_factory=list)
    """parts that the official reader cannot read by their index"""
    sent: int = 0
    recorded: int = 0
    """different messages in all parts"""
    repeated: int = 0
    """messages that occur more than once in the parts"""
    missing: int = 0
    """messages sent after the first recorded one that are in no part"""
    counted_missing: int = 0
    """the same by the ledgers"""
    kills_of_recording: int = 0
    """kills of a recorder that had started and caught up with what the bus held"""
    oldest_s: float = 0.0
    """age, at such a kill, of the oldest message that the kill lost"""
    newest_s: float = 0.0
    """age, at such a kill, of the newest message in the file"""


@dataclass(frozen=True)
class _Killed:
    """A killed recorder that had caught up with the bus: times in ns, and the messages due by key."""

    first_ns: int
    at_ns: int
    due: dict[str, int]
    newest_ns: int


class Kills:
    """A feed, and a recorder that is killed."""

    def __init__(self, folder: Path, endpoint: str, trays: int, fans: int, history: int) -> None:
        """history: how many messages the feed keeps for a recorder that comes back."""
        self._folder = folder
        self._config = folder / "fantwin.toml"
        tables = "".join(f'[[tray]]\nname = "tray{number + 1}"\nfans = {fans}\n' for number in range(trays))
        self._config.write_text(
            f'site = "{SITE}"\nrun_folder = "runs"\n[bus]\nendpoint = "{endpoint}"\n'
            f"[recorder]\ntopics = {list(TOPICS)}\n{tables}"
        )
        self._sent = folder / "sent.json"
        words = [sys.executable, str(Path(__file__).with_name("recorder_feed.py"))]
        words += [endpoint, str(trays), str(fans), str(history), str(self._sent)]
        root = str(Path(__file__).parents[2])
        self._feed = subprocess.Popen(
            words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env={"PYTHONPATH": root}
        )
        self._recorder: subprocess.Popen[bytes] | None = None
        self._started_ns = 0
        self._killed: list[_Killed] = []
        self._heard("feeding")

    def run(self, kills: int, seed: int, progress: Callable[[int], None] = lambda _: None) -> Outcome:
        """Kill it so many times, at random, and let the last one end in order."""
        chance = random.Random(seed)
        self._start()
        eventually(self._records, "the recorder records", every_s=0.25)
        for number in range(kills):
            time.sleep(chance.uniform(0.0, 4.0))  # at any moment, also while it starts or repairs
            self._kill()
            self._start()
            progress(number + 1)
        eventually(self._records, "the recorder records", every_s=0.25)
        assert self._feed.stdin and self._recorder
        self._feed.stdin.close()
        self._heard("fed")
        eventually(self._has_all, "the recorder has recorded all that was sent, or counted it as missing", every_s=0.25)
        self._recorder.send_signal(signal.SIGINT)
        status = self._recorder.wait(DEADLINE_S)
        assert status in (0, 3), (status, (self._folder / "recorder.log").read_text()[-2000:])
        return self._outcome(kills)

    def close(self) -> None:
        for process in (self._recorder, self._feed):
            if process and process.poll() is None:
                process.kill()
                process.wait()

    @property
    def _runs(self) -> Path:
        return self._folder / "runs"

    def _heard(self, word: str) -> None:
        assert self._feed.stdout
        assert self._feed.stdout.readline().strip() == word

    def _start(self) -> None:
        self._started_ns = time.time_ns()
        self._recorder = subprocess.Popen(
            [*FANTWIN, "up", "--only", "recorder", "-c", str(self._config)],
            stdin=subprocess.DEVNULL,
            stderr=(self._folder / "recorder.log").open("ab"),
            cwd=Path(__file__).parents[2],
        )

    def _kill(self) -> None:
        assert self._recorder
        at_ns = time.time_ns()
        assert self._recorder.poll() is None, (self._folder / "recorder.log").read_text()
        self._recorder.kill()
        self._recorder.wait()
        for active in self._runs.glob("*.active"):
            if active.stat().st_size < 8:
                continue
            found = scan(active)
            ledger = found.counts.ledger
            due = {key: ledger.next[key, producer] for key, producer in ledger.counts if producer == PRODUCER}
            recorders = [health for health in found.counts.sessions.values() if health.stage == "recorder"]
            has_caught_up = bool(recorders) and recorders[-1].status == StageStatus.OK
            if has_caught_up and found.first_ns is not None:
                self._killed.append(_Killed(found.first_ns, at_ns, due, found.last_ns or 0))

    def _records(self) -> bool:
        """Whether a message of the feed that was sent since the recorder started is in its file."""
        return any(found.last_ns and found.last_ns > self._started_ns for found in self._active())

    def _has_all(self) -> bool:
        """Whether the running recorder has recorded everything, or counted it as missing."""
        sent = {key: len(times) for key, times in json.loads(self._sent.read_text()).items()}
        return any(
            all(found.counts.ledger.next.get((key, PRODUCER)) == count for key, count in sent.items())
            for found in self._active()
        )

    def _active(self) -> Iterator[Contents]:
        """The file of the running recorder, read as far as it is written; none before it has been created."""
        for active in self._runs.glob("*.active"):
            with suppress(RecordingError):
                yield scan(active)

    def _parts(self) -> list[Path]:
        return sorted(self._runs.glob("*.mcap"), key=lambda path: int((re.findall(r"-(\d+)\.", path.name) or [1])[0]))

    def _outcome(self, kills: int) -> Outcome:
        outcome = Outcome(kills)
        sent_ns: dict[str, list[int]] = json.loads(self._sent.read_text())
        contents: list[Contents] = []
        found: dict[str, list[int]] = {key: [] for key in sent_ns}
        for path in self._parts():
            outcome.parts += 1
            if not _is_readable(path):
                outcome.unreadable.append(path.name)
            contents.append(contents_of(path))
            for envelope in read_recording(path, topics=("raw", "grid", "prediction", "score")):
                found[envelope.key].append(envelope.message.header.sequence)
        for key, times in sent_ns.items():
            recorded = set(found[key])
            outcome.sent += len(times)
            outcome.recorded += len(recorded)
            outcome.repeated += len(found[key]) - len(recorded)
            missing = [n for n in range(min(recorded, default=len(times)), len(times)) if n not in recorded]
            outcome.missing += len(missing)
            for killed in self._killed:
                due = killed.due.get(key, len(times))
                in_memory = [n for n in missing if n >= due and killed.first_ns <= times[n] <= killed.at_ns]
                if in_memory:
                    outcome.oldest_s = max(outcome.oldest_s, (killed.at_ns - times[in_memory[0]]) / 1e9)
        outcome.counted_missing = sum(
            account.missing for part in contents for (key, _), account in part.streams.items() if key in sent_ns
        )
        outcome.kills_of_recording = len(self._killed)
        outcome.newest_s = max(((killed.at_ns - killed.newest_ns) / 1e9 for killed in self._killed), default=0.0)
        return outcome


def _is_readable(path: Path) -> bool:
    """Return whether the official reader finds an index and correct checksums, and reads all messages by the index."""
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        if summary is None or summary.statistics is None:
            return False
        return summary.statistics.message_count == sum(1 for _ in reader.iter_messages())
