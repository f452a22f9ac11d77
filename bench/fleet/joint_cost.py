"""What a message of a small tray costs the integrator: each tray alone, and all trays in one pass.

Rough fans at 100 Hz under random stairs, watched by a calibrated twin of one such fan. The messages of all trays are
made outside of the measured time, and the cores run in this process. Both ways make the same messages, but for rounding
(tests/stages/test_large_tray.py). The scorer takes each tray alone.

    python -m bench.fleet.joint_cost
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from bench.detection.plant import START_NS
from bench.fleet.hall import Hall
from bench.fleet.stage_cost import SITE, calibrated_twin
from bench.printing import JsonOption, progress, show
from bench.stage_context import stage_context
from bench.training.published_fan import RATE_HZ
from fantwin.pipeline.config.loading import parse_config
from fantwin.pipeline.runtime.building import build_parts
from fantwin.pipeline.runtime.stage import Core, load_stage
from fantwin.pipeline.runtime.steps import step_together
from fantwin.schemas.messages import Grid, Message

STAGES = ("resampler", "twin_integrator")
BEGINNING_S = 5.0
"""time in which the free runs begin; it is not measured"""
BLOCKS_S = (0.05, 0.01)


def main(
    trays: Annotated[int, typer.Option(min=2, help="Of eight fans each.")] = 64,
    seconds: Annotated[float, typer.Option(help="That are measured.")] = 10.0,
    json_output: JsonOption = False,
) -> None:
    """Print microseconds of the processor for each message, by length of the messages and way."""
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        progress("training and calibrating the twin")
        twin = calibrated_twin(Path(folder))
        for block_s in BLOCKS_S:
            for together in (False, True):
                progress(f"messages of {block_s:g} s, {'in one pass' if together else 'each tray alone'}")
                rows.append(_row(twin, trays, block_s, seconds, together=together))
    show({"us of the processor for a message of a tray of 8": rows}, [], as_json=json_output)


def _row(twin: Path, trays: int, block_s: float, seconds: float, *, together: bool) -> dict[str, Any]:
    hall = Hall(8 * trays, 8, block_s)
    resampler, integrator = (_stepper(stage, twin, hall, together=together) for stage in STAGES)
    messages, spent_s = hall.messages(START_NS, []), 0.0
    for number in range(round((BEGINNING_S + seconds) * RATE_HZ / hall.block)):
        if number == round(BEGINNING_S * RATE_HZ / hall.block):
            spent_s = 0.0
        grids = [each for made in resampler(next(messages)) for each in made if isinstance(each, Grid)]
        if len(grids) < trays:
            continue
        began_s = time.process_time()
        integrator(grids)
        spent_s += time.process_time() - began_s
    count = trays * seconds * RATE_HZ / hall.block
    way = "in one pass" if together else "each tray alone"
    return {"message, s": block_s, "trays": trays, "way": way, "twin_integrator": spent_s / count * 1e6}


def _stepper(stage: str, twin: Path, hall: Hall, *, together: bool) -> Callable[[Sequence[Any]], list[list[Message]]]:
    """Steps the cores of all trays, with a message for each."""
    table = f'[[tray]]\nname = "{{}}"\nfans = 8\ntwin = "{twin}"\n'
    text = f'site = "{SITE}"\n[resampler]\nrate_hz = {RATE_HZ:g}\n' + "".join(map(table.format, hall.names))
    context = stage_context(parse_config(text, twin.parent / "fantwin.toml", (), STAGES), stage)
    declared = load_stage(stage)
    cores: list[Core] = [parts.core for parts in build_parts(declared, context).values()]
    joint = declared.joint() if declared.joint and together else None

    def step(items: Sequence[Any]) -> list[list[Message]]:
        if joint is not None:
            return list(step_together(joint, cores, items))
        return [list(core.step(item)) for core, item in zip(cores, items, strict=True)]

    return step


if __name__ == "__main__":
    typer.run(main)
