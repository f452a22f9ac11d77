"""A twin in Python: predict, score, save, and a module of PyTorch."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, TypeVar, overload

import numpy as np

from fantwin.interface.arguments import Rate, check
from fantwin.interface.columns import Columns, Fan
from fantwin.interface.fan_matching import matched
from fantwin.interface.suspicions import refuse_commands, refuse_high_speeds, suspect_times
from fantwin.interface.tables import NAME, FanTable, fan_table
from fantwin.interface.words import in_python, warn
from fantwin.pipeline.errors import FantwinError
from fantwin.pipeline.extras import require_torch
from fantwin.pipeline.files import write_whole
from fantwin.pipeline.prediction.tray_twin import read_file, tray_twin
from fantwin.schemas.twin_card import NOT_CALIBRATED, TwinCard
from fantwin.scoring.calibration.calibration import Calibration

if TYPE_CHECKING:
    from pandas import DataFrame
    from pyarrow import Table

    from fantwin.interface.answers import Answer
    from fantwin.interface.decisions import DecidedTray
    from fantwin.twin.fitting.torch_twin import TorchTwin

AnyTable = TypeVar("AnyTable")
USUAL = Columns()
DEMO = Path(__file__).parents[1] / "pipeline" / "demo" / "twin.onnx"


class Twin:
    """The model of healthy fans, from `load`, `train` or `calibrate`. It does not change.

    Tables: a pandas DataFrame, a pyarrow Table or a dict of arrays gives a table of the same library; `Columns` says
    what columns it must have. The path of a recording gives a DataFrame, and a dict of arrays where pandas is missing.
    A result has a row for each sample of a fan (*long*), at the rate of the twin: a table is resampled as a running
    site resamples it, and each decision is that of `fantwin replay --offline --twin` on the same samples.

    Times are seconds or dates as in the table, speeds in its unit, which their names end in, commands in its unit.

        >>> import fantwin
        >>> twin = fantwin.load()
        >>> twin
        Twin('demo tray', hybrid, 8 fans, 100 Hz, calibrated)
    """

    def __init__(self, content: bytes) -> None:
        """Use `fantwin.load`. content: of an ONNX file."""
        self.content = content
        self._known = tray_twin(Path("the twin"), content, None)
        self._latest: dict[str, DecidedTray] = {}

    @property
    def card(self) -> TwinCard:
        """All that is known of the twin: data, figures, parameters, ranges, band; speeds in rad/s. `print` shows the
        most important."""
        return self._known.card

    @property
    def fans(self) -> int:
        """Number of fans. A twin of one fan serves tables of any number."""
        return self._known.fans

    def __repr__(self) -> str:
        calibrated = "calibrated" if self.card.calibration else "not calibrated"
        if self.card.calibration and Calibration.model_validate(self.card.calibration).is_target:
            calibrated += ", its rate of false alarms is only a target"
        fans = f"{self.fans} fan{'s' * (self.fans != 1)}"
        return f"Twin({self.card.name!r}, {self.card.kind}, {fans}, {self.card.rate_hz:.3g} Hz, {calibrated})"

    def save(self, path: Path | str) -> Path:
        """Write the twin as an ONNX file, which `fantwin` commands and `load` take; returns its path.

        Raises:
            FantwinError: it cannot be written.
        """
        write_whole(Path(path), self.content, advice="")
        return Path(path)

    @overload
    def predict(self, table: Path | str, columns: Columns = ...) -> Any: ...
    @overload
    def predict(self, table: AnyTable, columns: Columns = ..., *, initial_speed_rpm: Any = ...) -> AnyTable: ...

    def predict(
        self,
        table: DataFrame | Table | Mapping[str, Any] | Path | str,
        columns: Columns = USUAL,
        *,
        initial_speed_rpm: Any = None,
    ) -> Any:
        """The speeds that healthy fans would have by these commands, and the band in which they are expected.

        Columns of the result: `time`, `fan`, `command`, and, with the unit at their ends, `speed` (measured),
        `predicted`, `sigma`, `lower` and `upper` (the band of two sigma, wider by what a tacho cannot resolve),
        `residual` (measured minus predicted); then `valid` (the residual is known, and says something) and `reason`
        (why not; empty if valid). The free run starts from the first measured speeds, and is never corrected by others.
        What is not known is NaN. `score` takes ten times as long, and has these columns, too.

        initial_speed_rpm: in place of measured speeds, for a table of commands alone: one for all fans or one for each,
        at its first time. The result is in rpm, without measured speed and residual.

        Raises:
            FantwinError: the table does not fit the twin.

        Warns:
            FantwinWarning: of what was repaired, left out or taken for granted.

        Examples:
            >>> import fantwin
            >>> commands = {"time": [0.00, 0.01, 0.02, 0.03], "command": [0.5, 0.5, 0.8, 0.8]}
            >>> predicted = fantwin.load().predict(commands, initial_speed_rpm=3000.0)
            >>> print(f"at {predicted['time'][-1]} s: {predicted['predicted_rpm'][-1]:.0f} rpm")
            at 0.03 s: 3059 rpm
        """
        if initial_speed_rpm is None:
            return self._answer(table, columns, "prediction")
        from fantwin.interface.free_run import free_run_columns  # noqa: PLC0415  `load` needs none of the pipeline

        with in_python():
            given = fan_table(table, columns, needs_speed=False)
            given = self.checked(given if len(given.fans) > 1 else given.of_each(self._fan_labels))
            return given.form.make(free_run_columns(self.content, given, initial_speed_rpm), given.form.zone)

    @overload
    def score(self, table: Path | str, columns: Columns = ..., *, false_alarms_per_day: float | None = ...) -> Any: ...
    @overload
    def score(
        self, table: AnyTable, columns: Columns = ..., *, false_alarms_per_day: float | None = ...
    ) -> AnyTable: ...

    def score(
        self,
        table: DataFrame | Table | Mapping[str, Any] | Path | str,
        columns: Columns = USUAL,
        *,
        false_alarms_per_day: float | None = None,
    ) -> Any:
        """What a scorer decides on each sample: the columns of `predict`, and

        `deviation` (of the residual, what is unusual for this fan), `score` (evidence for a fault, relative to its
        limit: an alarm is raised at 1), `limit` (1), `state` (normal, suspect, alarm, returning, stopped, starting,
        unknown), `alarm` (whether the fan has one), `severity` (warning, alarm; empty without), `cause` (the most
        probable one, as in docs/explanation/diagnosis.md) and `probability`.

        A scorer learns at the beginning of a table what is usual for each fan: a difference within the twin's declared
        error (`sigma` of its card) is taken for it. A fault that is already there and no larger is not found.

        false_alarms_per_day: of each fan, in place of the calibrated rate.

        Raises:
            FantwinError: the table does not fit the twin.

        Warns:
            FantwinWarning: as of `predict`, and of a twin that is not calibrated.
        """
        return self._answer(table, columns, "scores", false_alarms_per_day)

    @overload
    def alarms(self, table: Path | str, columns: Columns = ..., *, false_alarms_per_day: float | None = ...) -> Any: ...
    @overload
    def alarms(
        self, table: AnyTable, columns: Columns = ..., *, false_alarms_per_day: float | None = ...
    ) -> AnyTable: ...

    def alarms(
        self,
        table: DataFrame | Table | Mapping[str, Any] | Path | str,
        columns: Columns = USUAL,
        *,
        false_alarms_per_day: float | None = None,
    ) -> Any:
        """The alarms that `score` finds, a row for each.

        Columns: `fan`, `raised`, `cleared` (unknown if it lasts to the end), `onset` (when the fault probably began),
        `severity` (the highest), `cause` and `probability` of the last diagnosis, `causes` (all of it: a list of
        records with `cause` and `probability`). Arguments, errors and warnings are those of `score`, and so is what the
        beginning of a table means. After `score` of the same table it takes no time.
        """
        return self._answer(table, columns, "alarms", false_alarms_per_day)

    def evaluate(
        self, table: DataFrame | Table | Mapping[str, Any] | Path | str, columns: Columns = USUAL
    ) -> dict[str, Any]:
        """How well the twin follows healthy fans: the fields of `fantwin evaluate --json`, speeds in the table's unit.

        Among them `rmse` of the free run, `coverage_2_sigma` (the share of samples in the band), `assessment` (as
        declared, looser than declared, not followed, or not tested: on data that made the twin), its `headline`,
        `warnings`, and `fans` with the figures of each. `fantwin report` draws them.

        Raises:
            FantwinError: the table does not fit the twin.

        Warns:
            FantwinWarning: of what was repaired.
        """
        from fantwin.interface import answers  # noqa: PLC0415  `load` needs none of the pipeline

        with self.file() as file, in_python(file.parent) as words:
            if isinstance(table, Path | str):
                return answers.evaluation_of(Path(table), file, words)
            given = self.checked(fan_table(table, columns))
            words.fans = given.fans
            return answers.evaluation_of(answers.recording_of(given, self.card.tacho, file), file, words)

    def as_torch(self) -> TorchTwin:
        """The twin as a differentiable module of PyTorch, for control and for fits of one's own.

        Raises:
            FantwinError: PyTorch is not installed, or the twin is not continuous in time (NARX).
        """
        require_torch("as_torch()")
        from fantwin.twin.fitting.torch_twin import torch_twin  # noqa: PLC0415  torch takes seconds to import

        with in_python():
            return torch_twin(self.content, self.card)

    def _answer(self, table: Any, columns: Columns, answer: Answer, rate: float | None = None) -> Any:
        check("false_alarms_per_day", rate, Rate | None)
        overrides = () if rate is None else (f"scorer.false_alarms_per_day={rate}",)
        if not self.card.calibration and answer != "prediction":
            warn([f"{self.card.name!r} {NOT_CALIBRATED}; see fantwin.calibrate"])
        from fantwin.interface import answers  # noqa: PLC0415  `load` needs none of the pipeline

        with self.file() as file, in_python(file.parent) as words:
            if isinstance(table, Path | str):
                return answers.of_recording(Path(table), file, overrides, answer, words)
            given = self.checked(fan_table(table, columns))
            words.fans = given.fans
            return answers.of_table(given, file, overrides, answer, self._latest, words)

    @contextmanager
    def file(self) -> Iterator[Path]:
        """A temporary file of the twin, in a folder of its own."""
        with TemporaryDirectory(prefix="fantwin-") as folder:
            path = Path(folder) / "twin.onnx"
            path.write_bytes(self.content)
            yield path

    def checked(self, given: FanTable) -> FanTable:
        """The same samples, in the order of the fans of this twin. Raises FantwinError where they cannot be of them."""
        if self.fans > 1 and len(given.fans) != self.fans:
            raise FantwinError(
                f"{NAME} has {len(given.fans)} fan(s), and the twin is of {self.fans}: give a "
                "table of all of them, or use a twin of one fan"
            )
        if self.fans > 1:
            given = matched(given, self._fan_labels, "the twin")
        if np.isfinite(given.samples.speed_rad_s).any():  # commands alone may be as rare as they like
            suspect_times(given.samples, self._known)
        refuse_commands(given.samples, self.card)
        refuse_high_speeds(given.samples, self.card)
        needed = self.card.conditions.needed if self.card.conditions else ()
        if lacking := [name for name in needed if name not in given.samples.auxiliary]:
            raise FantwinError(f"{NAME} has no column {lacking[0]!r}, which the twin needs")
        return given

    @property
    def _fan_labels(self) -> tuple[Fan, ...]:
        """Names of the fans where all have one of their own, else their numbers."""
        names = self.card.training.fan_names
        return names if len({*names} - {""}) == self.fans else self.card.fan_numbers


def load(path: Path | str | None = None) -> Twin:
    """The twin in an ONNX file; without a path, that of the eight simulated fans of `fantwin demo`.

    Raises:
        FantwinError: it cannot be read, or is not a twin.
    """
    file = Path(path) if path is not None else DEMO
    if not file.is_file():
        raise FantwinError(f"{file}: there is no such file: give the .onnx file of a twin")
    with in_python():
        tray_twin(file, content := read_file(file), None)
    return Twin(content)
