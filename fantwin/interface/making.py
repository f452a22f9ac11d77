"""Twins made and calibrated from tables or recordings of healthy fans: `fantwin train` and `calibrate` in Python."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from pydantic import InstanceOf

from fantwin.interface.arguments import Count, Rate, Seed, check
from fantwin.interface.columns import Columns, Fan
from fantwin.interface.fan_matching import matched
from fantwin.interface.tables import fan_table
from fantwin.interface.twin import USUAL, Twin
from fantwin.interface.words import Words, in_python
from fantwin.pipeline.cli.progress import Reporter, training_progress
from fantwin.pipeline.errors import FantwinError
from fantwin.pipeline.learning.fitting import TrainingSettings, calibrated_on, fit_twin, with_calibration
from fantwin.pipeline.learning.healthy_evidence import marked_running, outlier_warnings, training_warnings
from fantwin.pipeline.learning.training_data import Part, read_held_out, read_training_data
from fantwin.pipeline.recordings.raw_recordings import write_table
from fantwin.pipeline.replay.offline.calibration_of_twin import require_enough
from fantwin.pipeline.replay.offline.healthy_runs import HealthyPart, in_this_process
from fantwin.pipeline.sources.tables.tachos import parse_tachos
from fantwin.schemas.fan_names import FanNames

if TYPE_CHECKING:
    from pandas import DataFrame
    from pyarrow import Table


def train(
    tables: DataFrame | Table | Mapping[str, Any] | Path | str | Sequence[Any],
    columns: Columns = USUAL,
    *,
    validate: DataFrame | Table | Mapping[str, Any] | Path | str | Sequence[Any] | None = None,
    tacho: str | Sequence[str] = (),
    name: str = "fan",
    model: str = "hybrid",
    seed: int = 0,
    iterations: int | None = None,
    networks: int | None = None,
    command_unit: str = "",
) -> Twin:
    """A twin of healthy fans, as by `fantwin train`; the same tables and seed give the same twin. A terminal or
    a notebook with ipywidgets shows a bar meanwhile.

    Args:
        tables: a table or the path of a recording, or a list of them. The fans have run at many commands.
        columns: of all tables.
        validate: others of the same kind. The band is as wide as the free-run error over them; without them it is that
            over the training data, which is too optimistic.
        tacho: how the speeds of tables were measured, such as `count:window_s=1,pulses=2`: one for all fans, or one for
            each; instantaneous without it. Recordings say it themselves.
        name: of the twin.
        model: physical, narx, neural-ode, hybrid or hybrid-w (docs/explanation/training.md).
        seed: of the initial weights.
        iterations: the most of each network; None: it depends on the model.
        networks: that are trained and averaged; None: four, or one where they cannot be averaged.
        command_unit: of the commands, for the card.

    Raises:
        FantwinError: a table cannot be used, or the data do not suffice.

    Warns:
        FantwinWarning: of what the data do not show, of outliers, and of what was repaired in a table.
    """
    for argument, value, kind in (("seed", seed, Seed), ("name", name, str), ("command_unit", command_unit, str)):
        check(argument, value, kind)
    for argument, value in (("iterations", iterations), ("networks", networks)):
        check(argument, value, Count | None)
    settings = TrainingSettings(model, seed, "levenberg-marquardt", iterations, networks, command_unit)
    with _recordings(columns) as recordings:
        both = recordings.of([*_each(tables), *(_each(validate) if validate is not None else ())], tacho)
        healthy, others = both[: len(_each(tables))], both[len(_each(tables)) :]
        words = recordings.words
        data = read_training_data(healthy, Part(), in_this_process)
        held_out = read_held_out(data, others, Part(), in_this_process) if others else None
        words.warn(line for each in (data, held_out) if each for line in (*each.damage, *each.hints))
        with training_progress(data, only_bar=True) as start:
            trained = fit_twin(data, held_out, name, settings, start(""))
        words.warn(data.with_fan_numbers(trained.identification.warnings))
        return Twin(trained.onnx())


def calibrate(
    twin: Twin,
    tables: DataFrame | Table | Mapping[str, Any] | Path | str | Sequence[Any],
    columns: Columns = USUAL,
    *,
    false_alarms_per_day: float,
    extrapolate: bool = False,
) -> Twin:
    """The same twin with the spread of its fans, and a declared rate of false alarms, in its card; as by
    `fantwin calibrate`. A terminal or a notebook with ipywidgets shows a bar meanwhile.

    Args:
        twin: not changed.
        tables: a table or the path of a recording, or a list of them: healthy fans, preferably other running than the
            twin was trained on.
        columns: of all tables.
        false_alarms_per_day: the rate to declare, of each fan. To show one false alarm a day takes 72 fan-hours.
        extrapolate: also with less running than shows the rate, which is then only a target.

    Raises:
        FantwinError: a table cannot be used, or there is too little running to show the rate.

    Warns:
        FantwinWarning: of fans that were perhaps not healthy, of tables that the twin was trained on, and of what was
            repaired in a table.
    """
    check("twin", twin, InstanceOf[Twin])
    check("false_alarms_per_day", false_alarms_per_day, Rate)
    with _recordings(columns) as recordings, twin.file() as file:
        healthy, words = recordings.of(_each(tables), twin), recordings.words
        if not extrapolate:
            require_enough(healthy, false_alarms_per_day)
        marked = marked_running(healthy, [], None, in_this_process)
        words.warn(marked.lines)
        part = HealthyPart(file, left_out=marked.left_out)
        with Reporter(only_bar=True) as reporter:
            reporter.show("calibrating")
            how = {"extrapolate": extrapolate, "progress": reporter.show}
            found = calibrated_on(healthy, part, false_alarms_per_day, in_this_process, **how)
        words.warn([*training_warnings(twin.card, found.calibration), *outlier_warnings(found)])
        return Twin(with_calibration(file, found.calibration))


@dataclass(frozen=True)
class _Recordings:
    """Temporary recordings of tables. words: of what concerns them."""

    folder: Path
    columns: Columns
    words: Words

    def of(self, tables: Sequence[Any], measured: Twin | str | Sequence[str]) -> list[Path]:
        """A recording of each table, and those that are recordings as they are. measured: how the speeds of the tables
        were measured, or the twin that they must fit."""
        paths = []
        fans: Sequence[Fan] = ()
        for number, table in enumerate(tables, 1):
            if isinstance(table, Path | str):
                paths.append(Path(table))
                continue
            given = fan_table(table, self.columns)
            if isinstance(measured, Twin):
                given, tachos = measured.checked(given), measured.card.tacho
            else:
                given = matched(given, fans or given.fans, "the first table")
                tachos = parse_tachos([measured] if isinstance(measured, str) else measured, len(given.fans))
            paths.append(self.folder / f"table-{number}.mcap")
            fans = given.fans
            names = FanNames(tuple(fan if isinstance(fan, str) else "" for fan in fans))
            write_table(given.samples, paths[-1], "table", tachos, names)
        self.words.fans = fans  # from here on, lines are about the recordings
        return paths


@contextmanager
def _recordings(columns: Columns) -> Iterator[_Recordings]:
    with TemporaryDirectory(prefix="fantwin-") as folder, in_python(Path(folder)) as words:
        yield _Recordings(Path(folder), columns, words)


def _each(tables: Any) -> Sequence[Any]:
    each = tables if isinstance(tables, Sequence) and not isinstance(tables, str) else [tables]
    if not each:
        raise FantwinError("no table was given: the list of tables is empty")
    return each
