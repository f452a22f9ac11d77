"""`fantwin calibrate`: what healthy recordings say of a twin's fans, and a declared false-alarm rate."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from fantwin.pipeline.cli.in_parallel import JobsOption, RecordingsInParallel, SkipBadOption
from fantwin.pipeline.cli.options import JsonOption, SetOption
from fantwin.pipeline.cli.progress import interruptible, show_part
from fantwin.pipeline.cli.twins.data_options import FromOption, ToOption, recordings_argument, recordings_option
from fantwin.pipeline.cli.twins.figures import closed_loop_sentence
from fantwin.pipeline.errors import UsageError, UserError
from fantwin.pipeline.files import write_whole
from fantwin.pipeline.learning.drops_found import drops_found
from fantwin.pipeline.learning.fitting import calibrated_on, with_calibration
from fantwin.pipeline.learning.healthy_evidence import (
    Check,
    check_declared_rate,
    marked_running,
    outlier_warnings,
    training_warnings,
)
from fantwin.pipeline.learning.loops_found import closed_loops
from fantwin.pipeline.prediction.tray_twin import load_tray_twin
from fantwin.pipeline.replay.offline.calibration_of_twin import (
    LARGEST_PER_DAY,
    number_text,
    rate_text,
)
from fantwin.pipeline.replay.offline.healthy_runs import HealthyPart
from fantwin.schemas.units import RAD_S_PER_UNIT
from fantwin.scoring.calibration.calibration import Calibration, changed_priors, expected_alarms, needed_fan_hours
from fantwin.scoring.model.population import Priors

EXIT_BROKEN = 3
MEANING = {
    "twin_share": "how far fans and runs differ from the twin on average, share of the speed",
    "air": "what the air does within an hour, share of the speed",
    "wander": "wandering of the speed over seconds, share of the speed",
}
"""words for the priors that are learned"""


def calibrate(
    twin: Annotated[Path, typer.Argument(metavar="TWIN.onnx", help="Twin whose alarms are calibrated.")],
    healthy: Annotated[
        list[Path] | None,
        recordings_argument(
            metavar="HEALTHY.mcap...",
            help="Healthy recordings, preferably not those that the twin was trained on.",
        ),
    ] = None,
    false_alarms_per_day: Annotated[
        float | None,
        typer.Option(help="The rate to declare: false alarms per fan and day.", min=1e-6, max=LARGEST_PER_DAY),
    ] = None,
    from_s: FromOption = 0.0,
    to_s: ToOption = math.inf,
    tray: Annotated[
        str | None,
        typer.Option(help="Use only this tray of the recordings, also of those to verify. Without it all are used."),
    ] = None,
    verify: Annotated[
        list[Path] | None,
        recordings_option(
            metavar="OTHER.mcap...",
            help="Other healthy recordings, to test the declared rate: all arguments up to the next option, so name "
            "TWIN.onnx and HEALTHY.mcap... before it.",
        ),
    ] = None,
    feedback: Annotated[
        list[Path] | None,
        recordings_option(
            metavar="FILE...",
            help="Other recordings, or the alarms.sqlite of a gateway, in which operators marked alarms of these "
            "recordings as true or false: all arguments up to the next option.",
        ),
    ] = None,
    extrapolate: Annotated[
        bool,
        typer.Option(
            "--extrapolate",
            help="Also with too few data to show the rate, which is then only a target.",
        ),
    ] = False,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="OUT.onnx", help="Write to this file, not into TWIN.onnx.")
    ] = None,
    overrides: SetOption = None,
    jobs: JobsOption = None,
    skip_bad: SkipBadOption = False,
    json_output: JsonOption = False,
) -> None:
    """Learn from healthy recordings how far a twin's fans may differ from it, and write that into its card.

    The limit of an alarm follows from the declared rate. It is checked on the recordings: every one is scored like a
    live fan, and where there are more false alarms than chance explains, the limit is raised. If the recordings are too
    few to show the rate, the command refuses and says how much is needed. A twin without calibration has the
    uncertainty of a population of fans, and one false alarm per fan and month.

    The time of an alarm that an operator has marked as true is left out, with the ten minutes before it.

    Exit codes: 0 success; 1 error; 3 --verify found more false alarms than declared; 4 recordings were skipped;
    130 Ctrl-C.

    Example: fantwin calibrate TWIN.onnx healthy-1.mcap healthy-2.mcap --false-alarms-per-day 1

    Example: fantwin calibrate TWIN.onnx --verify healthy-3.mcap healthy-4.mcap
    """
    _refuse_wrong_arguments(twin, healthy or [], verify or [], overrides or [])
    finding = {"--false-alarms-per-day": false_alarms_per_day, "--extrapolate": extrapolate, "--output": output}
    finding |= {"--from": from_s > 0.0, "--to": to_s < math.inf}
    if not healthy and (given := [name for name, value in finding.items() if value]):
        raise UsageError(
            f"{given[0]} needs recordings to calibrate on, and there are none: those after --verify only test; "
            "name HEALTHY.mcap... before it"
        )
    if output and (output.is_dir() or not output.parent.is_dir()):  # before an hour of scoring
        raise UserError(f"{output}: cannot write the twin: name a file in an existing folder")
    result: dict[str, Any] = {}
    check: Check | None = None
    pool = RecordingsInParallel(jobs, skip_bad)
    with interruptible("nothing was written"), pool:
        if healthy:
            if false_alarms_per_day is None:
                raise UsageError("declare a rate: --false-alarms-per-day X, for each fan; 0.03 is about one a month")
            marked = marked_running(healthy, feedback or [], tray, pool.map)
            for line in marked.lines:
                typer.echo(line, err=True)
            part = HealthyPart(twin, tuple(overrides or ()), from_s, to_s, tray, marked.left_out)
            how = {"extrapolate": extrapolate, "progress": show_part}
            found = calibrated_on(healthy, part, false_alarms_per_day, pool.map, **how)
            calibration, speed_unit = found.calibration, found.learned[0].tray.speed_unit
            output = output or twin
            card = load_tray_twin(twin).card
            closed = closed_loops(card, dict.fromkeys(run.tray.path for run in found.learned), tray)
            write_whole(output, with_calibration(twin, calibration, closed_loop=closed))
            drops = drops_found(output, RAD_S_PER_UNIT[speed_unit])
            warnings = [*training_warnings(card, calibration), *outlier_warnings(found)]
            loops = [fan for fan, is_closed in zip(card.fan_numbers, closed, strict=True) if is_closed]
            said = [closed_loop_sentence(found.learned[0].tray.names.labels(loops))] if loops else []
            result = {
                "twin": str(output),
                "alarms": marked.as_json(),
                "calibration": json.loads(calibration.model_dump_json()),
                "is_target": calibration.is_target,
                "warnings": warnings,
                "speed_unit": speed_unit,
                "drops_found": [drop.model_dump() for drop in drops],
                "closed_loop": loops,
            }
            for warning in warnings:
                typer.echo(warning, err=True)
            lines = _lines(output, calibration, [*said, *(drop.line(speed_unit) for drop in drops)])
            for line in () if json_output else lines:
                typer.echo(line)
        if verify:
            true_ones = marked_running(verify, feedback or [], tray, pool.map).left_out
            check = check_declared_rate(output or twin, verify, overrides or [], pool.map, tray, true_ones)
            result["verify"] = check.as_json()
    if json_output:
        typer.echo(json.dumps(result | pool.as_json()))
    elif check:
        typer.echo(check.text)
    pool.end(EXIT_BROKEN if check and check.is_broken else 0)


def _refuse_wrong_arguments(twin: Path, healthy: list[Path], verify: list[Path], overrides: list[str]) -> None:
    if not twin.is_file():
        raise UserError(f"{twin}: there is no such twin: name the file that `fantwin train` wrote")
    if not healthy and not verify:
        raise UsageError(
            "nothing to calibrate on: name healthy recordings, or --verify OTHER.mcap to test the declared rate"
        )
    for path in (path for path in verify if path.suffix == ".onnx"):
        raise UsageError(f"{path}: --verify takes recordings, and all arguments after it: name TWIN.onnx before it")
    counts = Counter(path.resolve() for path in (*healthy, *verify))
    for path in (path for path in (*healthy, *verify) if counts[path.resolve()] > 1):
        raise UsageError(f"{path}: named twice: every recording counts once, and --verify takes others")
    for key in (override.partition("=")[0].strip() for override in overrides if healthy):
        if key.startswith("scorer."):
            raise UsageError(f"--set {key}: [scorer] does not affect calibration: leave it out, or use --verify alone")


def _lines(output: Path, calibration: Calibration, drops: Sequence[str]) -> Iterator[str]:
    """What was learned, the false alarms that were found, what was done about them, and what may be promised."""
    runs = f"{calibration.runs} run{'s' * (calibration.runs != 1)}"
    yield f"{output}: calibrated on {calibration.fan_hours:.3g} fan-hours in {runs}"
    of_population = asdict(Priors())
    for name, value in changed_priors(calibration.priors).items():
        yield f"learned: {MEANING.get(name, name)}: {of_population[name]:.2g} -> {value:.2g}"
    if calibration.priors == Priors():
        yield "learned: nothing; the priors are those of a population of fans"
    per_day, (low, high) = calibration.false_alarms_per_day, calibration.interval_95
    expected = number_text(expected_alarms(calibration.fan_hours, per_day))
    interval = f"{number_text(low)} to {number_text(high)} per fan and day with 95 %"
    yield f"false alarms: {calibration.found} found, {expected} expected ({interval})"
    factor = f"the logarithm of that by theory times {calibration.limit_factor:.3g}: without this there were more"
    yield f"limit: {factor if calibration.limit_factor > 1.0 else 'by theory'}"
    if not calibration.is_target:
        yield f"declared: {rate_text(per_day)}"
    elif calibration.is_exceeded:
        why = "these recordings have more, of faults or of what a twin cannot know: see the warnings"
        yield f"target: {rate_text(per_day)}; {why}"
    else:
        yield f"target: {rate_text(per_day)}; {needed_fan_hours(per_day):.3g} fan-hours are needed to show it"
    yield from drops
    yield f"test it on other healthy recordings: fantwin calibrate {output} --verify OTHER.mcap"
