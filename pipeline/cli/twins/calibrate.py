"""`fantwin calibrate`: alarm limits from healthy recordings, for a declared false-alarm rate."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from pipeline.cli.options import JsonOption, SetOption
from pipeline.cli.progress import interruptible, show_part
from pipeline.cli.recordings_in_parallel import JobsOption, RecordingsInParallel, SchedulerOption, SkipBadOption
from pipeline.cli.twins.calibration_check import Check, check_declared_rate
from pipeline.cli.twins.drops_found import drop_lines, drops_found
from pipeline.cli.twins.marked_running import marked_running
from pipeline.cli.twins.outlier_run_check import outlier_warning
from pipeline.cli.twins.training_data import FromOption, ToOption, twin_errors
from pipeline.errors import UsageError, UserError
from pipeline.recordings.remote import matching, recording_path
from pipeline.replay.offline.healthy_runs import HealthyPart, HealthyRuns
from pipeline.replay.offline.kept_samples import KeptSamples
from pipeline.replay.offline.limits_of_twin import find_limits
from pipeline.runtime.tray_twin import load_tray_twin
from schemas.units import NS_PER_S, RAD_S_PER_UNIT, SpeedUnit
from scoring.calibration.calibration import MIN_S_OF_A_FAN, FragmentedError, TooLittleError, supports, too_little
from scoring.calibration.healthy_statistics import MixedRatesError
from scoring.detectors.table import calibrated_rows
from scoring.limits import Limits, Timing

EXIT_BROKEN = 3
MAX_KEPT_SAMPLES = 10_000_000
"""of fans, about 85 bytes each: so many are kept on the disk between passes, as many of each recording"""


def calibrate(
    twin: Annotated[Path, typer.Argument(metavar="TWIN.onnx", help="Twin whose alarms are calibrated.")],
    healthy: Annotated[
        list[Path] | None,
        typer.Argument(
            parser=recording_path,
            callback=matching,
            metavar="HEALTHY.mcap...",
            help="Healthy recordings, preferably not those that the twin was trained on.",
        ),
    ] = None,
    false_alarms_per_day: Annotated[
        float | None, typer.Option(help="The rate to declare: false alarms per fan and day.", min=1e-6, max=8640)
    ] = None,
    from_s: FromOption = 0.0,
    to_s: ToOption = math.inf,
    tray: Annotated[
        str | None,
        typer.Option(help="Use only this tray of the recordings, also of those to verify. Without it all are used."),
    ] = None,
    verify: Annotated[
        list[Path] | None,
        typer.Option(
            parser=recording_path,
            callback=matching,
            metavar="OTHER.mcap...",
            help="Other healthy recordings, to test the declared rate: all arguments up to the next option, so name "
            "TWIN.onnx and HEALTHY.mcap... before it.",
        ),
    ] = None,
    feedback: Annotated[
        list[Path] | None,
        typer.Option(
            parser=recording_path,
            callback=matching,
            metavar="FILE...",
            help="Other recordings, or the alarms.sqlite of a gateway, in which operators marked alarms of these "
            "recordings as true or false: all arguments up to the next option.",
        ),
    ] = None,
    extrapolate: Annotated[
        bool,
        typer.Option(
            "--extrapolate",
            help="Set limits by extrapolation if there are too few data for the rate, which is then only a target.",
        ),
    ] = False,
    alarms_left_out: Annotated[
        int,
        typer.Option(
            min=0,
            help="So many alarms, perhaps false ones, were raised while these were recorded, and the time around them "
            "is not in the recordings.",
        ),
    ] = 0,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="OUT.onnx", help="Write to this file, not into TWIN.onnx.")
    ] = None,
    overrides: SetOption = None,
    seed: Annotated[int, typer.Option(help="Seed of the bootstrap.")] = 0,
    jobs: JobsOption = None,
    scheduler: SchedulerOption = None,
    skip_bad: SkipBadOption = False,
    json_output: JsonOption = False,
) -> None:
    """Set the alarm limits of a twin from healthy recordings, and write them into its card.

    Every recording is scored like a live fan, with commissioning at its start. Limits are set so that false alarms are
    as frequent as declared. If the data cannot support the rate, the command refuses and says how much is needed.
    Without calibration only large errors of the speed, missing readings and standstill raise alarms.

    The time of an alarm that an operator has marked as true is left out, with the ten minutes before it.

    Exit codes: 0 success; 1 error; 3 --verify found more false alarms than declared; 4 recordings were skipped;
    130 Ctrl-C.

    Example: fantwin calibrate TWIN.onnx healthy-1.mcap healthy-2.mcap --false-alarms-per-day 1

    Example: fantwin calibrate TWIN.onnx --verify healthy-3.mcap healthy-4.mcap
    """
    _refuse_wrong_arguments(twin, healthy or [], verify or [], overrides or [])
    if not healthy:
        finding = {"--false-alarms-per-day": false_alarms_per_day, "--extrapolate": extrapolate, "--output": output}
        finding |= {"--alarms-left-out": alarms_left_out, "--from": from_s > 0.0, "--to": to_s < math.inf}
        _refuse_without_healthy([name for name, value in finding.items() if value])
    if output and (output.is_dir() or not output.parent.is_dir()):  # before an hour of scoring
        raise UserError(f"{output}: cannot write the twin: name a file in an existing folder")
    result: dict[str, Any] = {}
    check: Check | None = None
    pool = RecordingsInParallel(jobs, scheduler, skip_bad)
    with interruptible("nothing was written"), pool:
        if healthy:
            if false_alarms_per_day is None:
                raise UsageError("declare a rate: --false-alarms-per-day X, for each fan; 0.03 is about one a month")
            marked = marked_running(healthy, feedback or [], tray, pool)
            for line in marked.lines:
                typer.echo(line, err=True)
            part = HealthyPart(twin, tuple(overrides or ()), from_s, to_s, tray, marked.left_out)
            limits, warning, speed_unit = _calibrated(
                healthy, part, false_alarms_per_day, pool, extrapolate, alarms_left_out, seed
            )
            output = output or twin
            _write(twin, output, limits)
            drops = drops_found(output, RAD_S_PER_UNIT[speed_unit])
            result = {
                "twin": str(output),
                "alarms": marked.as_json(),
                "calibration": json.loads(limits.model_dump_json()),
                "warnings": [warning] if warning else [],
                "speed_unit": speed_unit,
                "drops_found": [drop.as_json() for drop in drops],
            }
            if warning:
                typer.echo(warning, err=True)
            if not json_output:
                _print(output, limits, drop_lines(drops, speed_unit))
        if verify:
            true_ones = marked_running(verify, feedback or [], tray, pool).left_out
            check = check_declared_rate(output or twin, verify, overrides or [], pool, tray, true_ones)
            result["verify"] = check.as_json()
    if json_output:
        typer.echo(json.dumps(result | pool.as_json()))
    elif check:
        typer.echo(check.text)
    pool.end(EXIT_BROKEN if check and check.is_broken else 0)


def _calibrated(
    healthy: list[Path],
    part: HealthyPart,
    per_day: float,
    pool: RecordingsInParallel,
    extrapolate: bool,
    alarms_left_out: int,
    seed: int,
) -> tuple[Limits, str, SpeedUnit]:
    """The limits, a warning about the recordings, empty if there is none, and the unit of speeds in the first."""
    known = load_tray_twin(part.twin)
    top_speed_rad_s = known.card.top_speed_rad_s
    if top_speed_rad_s <= 0.0:
        raise UserError(f"{part.twin}: its training data have no speed above zero (speed_range_rad_s): train it again")
    with TemporaryDirectory(prefix="fantwin-calibrate-") as folder:
        kept = KeptSamples(Path(folder), MAX_KEPT_SAMPLES // len(healthy))
        runs = HealthyRuns(healthy, part, pool.map, kept, show_part)
        timing = runs.timing()
        try:
            longest_fan_s = runs.longest_fan_s()  # however much of it can be scored
            if not extrapolate and not supports(longest_fan_s, per_day):
                raise too_little(longest_fan_s, per_day)
            limits = find_limits(
                [known], runs, timing, per_day, seed=seed, extrapolate=extrapolate, alarms_left_out=alarms_left_out
            )
        except TooLittleError as error:
            raise UserError(_too_little(error, per_day, extrapolate=extrapolate)) from error
        except MixedRatesError as error:
            raise UserError(_mixed_rates(error)) from error
        except FragmentedError as error:
            raise UserError(_fragmented(error)) from error
        warning = outlier_warning(runs, limits, top_speed_rad_s)
    assert limits.declared_rate
    declared_rate = limits.declared_rate.model_copy(
        update={
            "data": tuple(
                {"name": path.name, "sha256": sha256, **_part(part)} for path, sha256 in runs.sha256().items()
            ),
            "created": datetime.now(UTC).isoformat(timespec="seconds"),
        }
    )
    return limits.model_copy(update={"declared_rate": declared_rate}), warning, runs.speed_unit


def _part(part: HealthyPart) -> dict[str, float | str]:
    """The part of each recording, for the card; empty for the whole."""
    wanted: dict[str, float | str] = {"from_s": part.from_s} if part.from_s > 0.0 else {}
    wanted |= {"to_s": part.to_s} if part.to_s < math.inf else {}
    return wanted | ({"tray": part.tray} if part.tray else {})


def _refuse_wrong_arguments(twin: Path, healthy: list[Path], verify: list[Path], overrides: list[str]) -> None:
    if not twin.is_file():
        raise UserError(f"{twin}: there is no such twin: name the file that `fantwin train` wrote")
    if not healthy and not verify:
        raise UsageError(
            "nothing to calibrate on: name healthy recordings, or --verify OTHER.mcap to test the declared rate"
        )
    for path in (path for path in verify if path.suffix == ".onnx"):
        raise UsageError(f"{path}: --verify takes recordings, and all arguments after it: name TWIN.onnx before it")
    _named_once([*healthy, *verify])
    for key in (override.partition("=")[0].strip() for override in overrides if healthy):
        if key.startswith("scorer.") and key.removeprefix("scorer.") not in Timing.model_fields:
            raise UsageError(
                f"--set {key}: does not affect calibration; of [scorer] these do: {', '.join(Timing.model_fields)}"
            )


def _refuse_without_healthy(names: list[str]) -> None:
    """names: options that were given and are for calibrating."""
    if names:
        raise UsageError(
            f"{names[0]} needs recordings to calibrate on, and there are none: those after --verify only test; "
            "name HEALTHY.mcap... before it"
        )


def _named_once(recordings: list[Path]) -> None:
    """Refuse a recording that is named twice: it would count its time twice, and it cannot test its own calibration."""
    seen: set[Path] = set()
    for path in recordings:
        if path.resolve() in seen:
            raise UsageError(f"{path}: named twice: every recording counts once, and --verify takes others")
        seen.add(path.resolve())


def _too_little(error: TooLittleError, per_day: float, *, extrapolate: bool) -> str:
    if error.fan_hours < error.needed_fan_hours and not extrapolate:
        return (
            f"{error.fan_hours:.2g} fan-hours of healthy running cannot support {_rate(per_day)}: that takes "
            f"{error.needed_fan_hours:.3g}; record more, declare {_round_up(error.least_per_day):g} or more, or set "
            "limits beyond what was recorded, which declare no rate: add --extrapolate"
        )
    scored = f"{error.fan_hours * 3600:.0f} s of healthy running could be scored, all fans together"
    return (
        f"{scored}: too little for any limit; that takes {MIN_S_OF_A_FAN:.0f} s of each fan: "
        "record two minutes or more, better ten"
    )


def _mixed_rates(error: MixedRatesError) -> str:
    (first, first_ns), (other, other_ns) = error.first, error.other
    rates = f"{NS_PER_S / first_ns:g} Hz and {NS_PER_S / other_ns:g} Hz"
    if first == other:
        return f"{first}: its trays have grids of different rates, {rates}, and limits hold for one: choose with --tray"
    return (
        f"{first} and {other} have grids of different rates, {rates}, and limits hold for one: calibrate on recordings "
        "of one rate, or choose one with --set resampler.rate_hz=..."
    )


def _fragmented(error: FragmentedError) -> str:
    what = "speed" if error.source == "speed" else "torque balance"
    return (
        f"the {what} was scored for {error.scored_s:.0f} s, but never for a whole second: each lacks samples, "
        "so no limit can be set; `fantwin info` shows what is missing, `fantwin doctor` what does not fit the line"
    )


def _rate(per_day: float) -> str:
    return f"{per_day:g} false alarm{'s' * (per_day != 1)} per fan and day"


def _runs(count: int) -> str:
    return f"{count} run{'s' * (count != 1)}"


def _round_up(rate: float) -> float:
    """Rounded up to two digits, so that the printed rate is sufficient."""
    unit = 10.0 ** (math.floor(math.log10(rate)) - 1)
    return math.ceil(rate / unit) * unit


def _write(twin: Path, output: Path, limits: Limits) -> None:
    with twin_errors():
        from twin.export.card_entries import with_card_entries  # noqa: PLC0415  the command line loads twin only when needed

        content = with_card_entries(twin.read_bytes(), {"calibration": json.loads(limits.model_dump_json())})
    beside = output.with_name(output.name + ".new")
    try:
        beside.write_bytes(content)
        beside.replace(output)
    except OSError as error:
        raise UserError(f"{output}: cannot write the twin: {error.strerror}") from error


def _print(output: Path, limits: Limits, drops: Sequence[str]) -> None:
    rate = limits.declared_rate
    assert rate
    console = Console(highlight=False, soft_wrap=True)
    console.print(f"{output}: alarms calibrated on {rate.fan_hours:.3g} fan-hours in {_runs(rate.runs)}", markup=False)
    table = Table("detector", "settings", box=None, pad_edge=False)
    for row in calibrated_rows():
        settings = limits.detectors.get(row.name)
        in_use = [(name, value) for name, value in settings or () if value is not None]
        shown = ", ".join(f"{name} {value:.3g}" for name, value in in_use) or "not used"
        table.add_row(row.name, shown)
    console.print(table)
    declared = _rate(rate.false_alarms_per_day)
    if rate.extrapolated:
        console.print(f"[yellow]target: {declared}; the data are too few to show whether these limits keep it[/yellow]")
    else:
        low, high = rate.interval_95
        console.print(f"declared: {declared} (95 % interval from these data: {low:.3g} to {high:.3g})")
    for line in drops:
        console.print(line, markup=False)
    console.print("test it on other healthy recordings: fantwin calibrate TWIN.onnx --verify OTHER.mcap")
