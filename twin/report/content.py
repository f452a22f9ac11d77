"""What a report says, in numbers: a twin run freely over recordings, fan by fan."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from operator import add
from typing import Any

import numpy as np

from fantwin.schemas.twin_card import DataCard, DriveCard, TwinCard
from fantwin.twin.build import runs_of_twin
from fantwin.twin.evaluation.accuracy import Evaluation, Figures, evaluation_pieces, free_run_of_piece
from fantwin.twin.evaluation.residual_analysis import ResidualAnalysis, analysis_of
from fantwin.twin.export.fan_rows import drive_of_fans, fan_rows
from fantwin.twin.export.onnx_twin import OnnxTwin
from fantwin.twin.report.recording_sums import Extent, RecordingSums, SpeedBin, extent_of, sums_of_free_run
from fantwin.twin.report.timeline import Timeline, timeline
from fantwin.twin.runs import Array, Run


@dataclass(frozen=True)
class SpeedUnit:
    """The unit in which speeds are displayed, and its size in rad/s."""

    name: str
    rad_s: float


@dataclass(frozen=True)
class Parameter:
    """A physical parameter of one fan: as identified, its 95 % interval, and in force.

    The last differs where a hybrid has refined its physics along with its network, which has taken a share.
    """

    name: str
    value: float
    low: float
    high: float
    in_force: float


@dataclass(frozen=True, eq=False)
class FanSummary:
    """One fan without its samples. row: of the twin. number, label: as the recordings call it. fastest_rad_s: the
    largest measured speed. missing_share, outside_share: of the samples without a speed, and with a command outside the
    trained range. error_std_rad_s: of the free-run errors that are finite; NaN without any."""

    row: int
    number: int
    label: str
    figures: Figures
    sigma_rad_s: float
    fastest_rad_s: float
    missing_share: float
    outside_share: float
    error_std_rad_s: float
    parameters: tuple[Parameter, ...]
    residual: ResidualAnalysis
    by_speed: tuple[SpeedBin, ...]

    @property
    def rmse_in_sigma(self) -> float:
        """The free-run error in healthy standard deviations; NaN where nothing was measured."""
        return float(np.divide(self.figures.rmse_rad_s, self.sigma_rad_s))


@dataclass(frozen=True, eq=False)
class Summary:
    """What is assessed. recordings: the files evaluated."""

    twin: OnnxTwin
    unit: SpeedUnit
    recordings: tuple[DataCard, ...]
    evaluation: Evaluation
    rate_hz: float
    fans: Sequence[FanSummary]

    @property
    def card(self) -> TwinCard:
        """The twin's."""
        return self.twin.card


@dataclass(frozen=True, eq=False)
class FanContent(FanSummary):
    """One fan with its samples. column: of the runs. Arrays (n,) are in rad/s or command units, over all pieces one
    after the other; predicted_rad_s: NaN where the free run diverged; error_rad_s: the residual of accuracy.FreeRun.
    auxiliary: other measured columns, (n,) by name, NaN where not measured."""

    column: int
    command: Array
    drive: DriveCard | None
    measured_rad_s: Array
    predicted_rad_s: Array
    error_rad_s: Array
    auxiliary: Mapping[str, Array]

    @property
    def raised_command(self) -> Array:
        """(n,) the command, or with a drive the end of its plateau if that is higher."""
        return self.drive.raised(self.command[:, np.newaxis])[:, 0] if self.drive else self.command


@dataclass(frozen=True, eq=False)
class Content(Summary):
    """All that a page shows. The name of a recording appears in Timeline without its ending."""

    fans: tuple[FanContent, ...]
    pieces: tuple[Run, ...]
    timeline: Timeline


def summary_of(
    twin: OnnxTwin,
    sums: RecordingSums,
    extent: Extent,
    recordings: Sequence[DataCard],
    unit: SpeedUnit,
    fan_numbers: Sequence[int] | None = None,
    labels: Sequence[str] | None = None,
) -> Summary:
    """What is assessed, from the sums over recordings of this extent. recordings, fan_numbers, labels: as of
    report_content.

    Raises TwinError when the fans do not fit.
    """
    card, evaluation = twin.card, sums.figures.evaluation()
    fans = len(evaluation.per_fan)
    residuals = analysis_of(sums.residual, extent.grid)
    error_std_rad_s = sums.by_speed.error_std_rad_s()
    rows, numbers = fan_rows(card, fans, fan_numbers), fan_numbers or range(fans)
    return Summary(
        twin=twin,
        unit=unit,
        recordings=tuple(recordings),
        evaluation=evaluation,
        rate_hz=1.0 / extent.median_step_s,
        fans=tuple(
            FanSummary(
                row=row,
                number=number,
                label=labels[fan] if labels else f"fan {number}",
                figures=evaluation.per_fan[fan],
                sigma_rad_s=float(card.sigma_rad_s[row]),
                fastest_rad_s=float(sums.fastest_rad_s[fan]),
                missing_share=float(sums.missing[fan]) / sums.samples,
                outside_share=float(sums.outside[fan]) / sums.samples,
                error_std_rad_s=float(error_std_rad_s[fan]),
                parameters=_parameters(twin, row),
                residual=residuals[fan],
                by_speed=sums.by_speed.bins(fan, extent.range_rad_s[:, fan]),
            )
            for fan, (row, number) in enumerate(zip(rows, numbers, strict=True))
        ),
    )


def report_content(
    twin: OnnxTwin,
    runs: Sequence[Run],
    recordings: Sequence[DataCard],
    unit: SpeedUnit,
    fan_numbers: Sequence[int] | None = None,
    labels: Sequence[str] | None = None,
) -> Content:
    """Run the twin over the runs. recordings: the files that the runs came from. fan_numbers: see build.runs_of_twin.
    labels: of its columns, what people call them; None: by their numbers.

    Raises TwinError when the twin does not fit the runs, or there is nothing to evaluate.
    """
    of, extent = runs_of_twin(twin, runs, fan_numbers), extent_of(runs)
    pieces = tuple(evaluation_pieces(of.runs))
    free_runs = [free_run_of_piece(of.model, of.parameters, piece) for piece in pieces]
    sums = reduce(add, (sums_of_free_run(of, each, extent) for each in free_runs))
    summary = summary_of(twin, sums, extent, recordings, unit, fan_numbers, labels)
    command, measured = (
        np.concatenate([getattr(piece, name) for piece in pieces]) for name in ("command", "speed_rad_s")
    )
    expected, error = (
        np.concatenate([getattr(each, name) for each in free_runs]) for name in ("expected_rad_s", "residual_rad_s")
    )
    predicted = np.where(np.isfinite(expected), expected, np.nan)
    measured_beside = _auxiliary(evaluation_pieces(runs))
    fans = tuple(
        FanContent(
            **vars(fan),
            column=column,
            command=command[:, column],
            drive=drive_of_fans(twin.card, [fan.row]),
            measured_rad_s=measured[:, column],
            predicted_rad_s=predicted[:, column],
            error_rad_s=error[:, column],
            auxiliary={name: of[:, column] for name, of in measured_beside.items()},
        )
        for column, fan in enumerate(summary.fans)
    )
    fields: dict[str, Any] = vars(summary) | {"fans": fans}
    return Content(**fields, pieces=pieces, timeline=timeline(pieces))


def _auxiliary(pieces: Sequence[Run]) -> dict[str, Array]:
    """By name, the columns beside command and speed, (n, fans); NaN in pieces without the column."""
    names = dict.fromkeys(name for piece in pieces for name in piece.auxiliary)
    return {
        name: np.concatenate([piece.auxiliary.get(name, np.full_like(piece.command, np.nan)) for piece in pieces])
        for name in names
    }


def _parameters(twin: OnnxTwin, row: int) -> tuple[Parameter, ...]:
    card = twin.card
    return tuple(
        Parameter(name, float(value), float(low), float(high), float(used))
        for name, value, (low, high), used in zip(
            card.parameter_names,
            card.identified_parameters[row],
            card.parameter_interval_95[row],
            twin.parameters[row],
            strict=True,
        )
    )
