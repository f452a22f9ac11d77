"""The campaign of the racks: each rack learns and is judged by itself, in worker processes; what is done is kept."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

from pydantic import TypeAdapter

from bench.detection.rack_recordings import FAULTY, HEALTHY, RackData
from bench.detection.rack_scoring import Judged, judged, other_methods, twin_of

_JUDGED = TypeAdapter(Judged)


@dataclass(frozen=True)
class RackResult:
    """What was made of one rack with one amount of learning."""

    rack: int
    learning: str
    faulty: Judged
    healthy: Judged | None
    """None where only the faulty test was judged"""


def campaign(
    data: RackData,
    learning: Sequence[str],
    racks: int,
    healthy_racks: int,
    workers: int,
    progress: Callable[[str], None],
) -> list[RackResult]:
    """Results of the first `racks` of the racks, those kept from before included.

    healthy_racks: so many of them are judged without faults, too.

    Raises:
        UserError: what the racks have learned from does not suffice.
    """
    data.make(learning, progress)
    done = []
    with ProcessPoolExecutor(workers, mp_context=get_context("fork")) as pool:  # so that they see what is left out
        jobs = [pool.submit(one_rack, data, rack, learning, rack < healthy_racks) for rack in range(racks)]
        for job in as_completed(jobs):
            done += job.result()
            progress(f"{len(done) // len(learning)} of {len(jobs)} racks at {data.rate_hz:g} Hz")
    return sorted(done, key=lambda one: (one.learning, one.rack))


def one_rack(data: RackData, rack: int, learning: Sequence[str], is_healthy_judged: bool) -> list[RackResult]:
    """The results of one rack."""
    return list(_of_rack(data, rack, learning, is_healthy_judged))


def _of_rack(data: RackData, rack: int, learning: Sequence[str], is_healthy_judged: bool) -> Iterator[RackResult]:
    for name in learning:
        twin = twin_of(data, rack, name)
        tests = (FAULTY, HEALTHY) if is_healthy_judged else (FAULTY,)
        made = [_judged(data, rack, name, test, twin) for test in tests]
        yield RackResult(rack, name, made[0], made[1] if is_healthy_judged else None)


def _judged(data: RackData, rack: int, learning: str, test: str, twin: Path) -> Judged:
    recording = data.test(test, rack)
    kept = recording.with_name(f"{recording.stem}-{data.kept_name(learning)}.json")
    if kept.exists():
        return _JUDGED.validate_json(kept.read_bytes())
    found = judged(recording, twin, other_methods(data, rack, learning, twin))
    kept.write_bytes(_JUDGED.dump_json(found))
    return found
