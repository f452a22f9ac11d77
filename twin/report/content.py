"""What a report says, in numbers: a twin run freely over recordings, fan by fan."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from schemas.twin_card import DataCard, DriveCard, TwinCard
from twin.build import evaluate
from twin.evaluation.accuracy import Evaluation, Figures, compared_readings, evaluation_pieces, free_run_readings
from twin.evaluation.residual_analysis import ResidualAnalysis, analyse_residual
from twin.export.fan_rows import drive_of_fans, fan_rows, measured_as_in_card
from twin.export.onnx_twin import OnnxTwin
from twin.report.speed_bins import SpeedBin, speed_bins
from twin.report.timeline import Timeline, timeline
from twin.runs import Array, Run, common_fans


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
class FanContent:
    """One fan. Arrays (n,) are in rad/s or command units, over all pieces one after the other.

    column: of the runs. row: of the twin. number: as the recording counts fans. predicted_rad_s: the readings expected
    of the free run, NaN where it diverged. error_rad_s: measured minus that, NaN where nothing is compared, infinite
    where the free run diverged.
    """

    column: int
    row: int
    number: int
    figures: Figures
    sigma_rad_s: float
    command: Array
    drive: DriveCard | None
    measured_rad_s: Array
    predicted_rad_s: Array
    error_rad_s: Array
    parameters: tuple[Parameter, ...]
    residual: ResidualAnalysis
    by_speed: tuple[SpeedBin, ...]

    @property
    def raised_command(self) -> Array:
        """(n,) the command, or with a drive the end of its plateau if that is higher."""
        return self.drive.raised(self.command[:, np.newaxis])[:, 0] if self.drive else self.command

    @property
    def rmse_in_sigma(self) -> float:
        """The free-run error in healthy standard deviations; NaN where nothing was measured."""
        return float(np.divide(self.figures.rmse_rad_s, self.sigma_rad_s))


@dataclass(frozen=True, eq=False)
class Content:
    """All that a page shows. recordings: the files evaluated, the name of one appearing in Timeline without its
    ending."""

    twin: OnnxTwin
    pieces: tuple[Run, ...]
    unit: SpeedUnit
    recordings: tuple[DataCard, ...]
    evaluation: Evaluation
    timeline: Timeline
    rate_hz: float
    fans: tuple[FanContent, ...]

    @property
    def card(self) -> TwinCard:
        """The twin's."""
        return self.twin.card


def report_content(
    twin: OnnxTwin,
    runs: Sequence[Run],
    recordings: Sequence[DataCard],
    unit: SpeedUnit,
    fan_numbers: Sequence[int] | None = None,
) -> Content:
    """Run the twin over the runs. recordings: the files that the runs came from. fan_numbers: see build.evaluate.

    Raises TwinError when the twin does not fit the runs, or there is nothing to evaluate.
    """
    evaluation = evaluate(twin, runs, fan_numbers)
    fans = common_fans(runs)
    rows = fan_rows(twin.card, fans, fan_numbers)
    pieces = evaluation_pieces(measured_as_in_card(twin.card, rows, runs))
    parameters, sigma_rad_s = twin.parameters[rows], np.array(twin.card.sigma_rad_s)[rows]
    identified, intervals_95 = (
        np.array(of_card)[rows] for of_card in (twin.card.identified_parameters, twin.card.parameter_interval_95)
    )
    command, measured = (
        np.concatenate([getattr(piece, name) for piece in pieces]) for name in ("command", "speed_rad_s")
    )
    predicted = np.concatenate([free_run_readings(twin, parameters, piece) for piece in pieces])
    predicted[~np.isfinite(predicted)] = np.nan
    compared = np.concatenate([compared_readings(piece) for piece in pieces])
    error = np.where(np.isfinite(compared) & ~np.isfinite(predicted), np.inf, compared - predicted)
    residuals = analyse_residual(error, pieces)
    return Content(
        twin=twin,
        pieces=tuple(pieces),
        unit=unit,
        recordings=tuple(recordings),
        evaluation=evaluation,
        timeline=timeline(pieces),
        rate_hz=1.0 / float(np.median(np.concatenate([np.diff(piece.t_s) for piece in pieces]))),
        fans=tuple(
            FanContent(
                column=fan,
                row=rows[fan],
                number=fan_numbers[fan] if fan_numbers is not None else fan,
                figures=evaluation.per_fan[fan],
                sigma_rad_s=float(sigma_rad_s[fan]),
                command=command[:, fan],
                drive=drive_of_fans(twin.card, rows[fan : fan + 1]),
                measured_rad_s=measured[:, fan],
                predicted_rad_s=predicted[:, fan],
                error_rad_s=error[:, fan],
                parameters=_parameters(twin.card, identified[fan], intervals_95[fan], parameters[fan]),
                residual=residuals[fan],
                by_speed=speed_bins(predicted[:, fan], error[:, fan]),
            )
            for fan in range(fans)
        ),
    )


def _parameters(card: TwinCard, values: Array, intervals_95: Array, in_force: Array) -> tuple[Parameter, ...]:
    return tuple(
        Parameter(name, float(value), float(low), float(high), float(used))
        for name, value, (low, high), used in zip(card.parameter_names, values, intervals_95, in_force, strict=True)
    )
