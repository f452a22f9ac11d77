"""The free run of a twin from given initial speeds by the commands of a table, which has no measured speeds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from fantwin.interface.decisions import labels
from fantwin.interface.tables import NAME, Array, FanTable
from fantwin.pipeline.errors import FantwinError
from fantwin.pipeline.prediction.free_run import FreeRun
from fantwin.pipeline.prediction.tray_integrator import HIGHEST_SPEED
from fantwin.pipeline.prediction.twin_file import TwinFile
from fantwin.pipeline.replay.resolve_config import rounded_rate_hz
from fantwin.schemas.enums import InvalidReason
from fantwin.schemas.units import NS_PER_S, RAD_S_PER_UNIT
from fantwin.scoring.score_message import BAND_SIGMAS


def free_run_columns(content: bytes, table: FanTable, initial_speed_rpm: Any) -> dict[str, Array]:
    """The predicted speeds at the rate of the twin, (samples * fans,) each; commands are held until the next one.

    content: of the file of the twin. initial_speed_rpm: at the first time of the table, of all fans or (fans,).

    Raises:
        FantwinError: the twin needs the supply voltage or the temperature, or the table has measured speeds.
    """
    form, samples, fans = table.form, table.samples, len(table.fans)
    if np.isfinite(samples.speed_rad_s).any():
        raise FantwinError(f"{NAME} has measured speeds, from which a prediction starts: leave out initial_speed_rpm")
    initial_rad_s = _of_each_fan(initial_speed_rpm, fans) * RAD_S_PER_UNIT["rpm"]
    twin = TwinFile.of_content(Path("the twin"), content, fans)
    card = twin.card
    low, high = min(0.0, HIGHEST_SPEED * card.speed_range_rad_s[0]), HIGHEST_SPEED * card.top_speed_rad_s
    if not ((initial_rad_s >= low) & (initial_rad_s <= high)).all():
        low, high = (round(each / RAD_S_PER_UNIT["rpm"]) for each in (low, high))
        raise FantwinError(f"initial_speed_rpm = {initial_speed_rpm!r}: the twin knows {low} to {high} rpm")
    if card.conditions:
        raise FantwinError(
            f"the twin needs {' and '.join(card.conditions.needed)}: predict a table with measured speeds"
        )
    period_ns = round(NS_PER_S / rounded_rate_hz(card.rate_hz))
    t_ns = np.arange(samples.t_ns[0], samples.t_ns[-1] + 1, period_ns)
    command = samples.command[np.searchsorted(samples.t_ns, t_ns, side="right") - 1]
    run = FreeRun(twin)
    run.set_period(period_ns)
    all_fans = np.ones(twin.fans, np.bool_)
    while not run.add_readings(all_fans, initial_rad_s).all():
        pass
    run.start(all_fans, int(t_ns[0]), command[0])
    parts: list[tuple[Array, Array]] = []
    while (done := sum(len(reading) for reading, _ in parts)) < len(t_ns):
        reading, half_range, _ = run.advance(command[done:])
        parts.append((reading, half_range))
    predicted, half_range = (np.concatenate(each) for each in zip(*parts, strict=True))
    raised = twin.drive.raised(command) if twin.drive else command
    unseen = twin.unseen_error.table.unseen_std_at(predicted, raised) if twin.unseen_error else 0.0
    band = BAND_SIGMAS * np.hypot(twin.sigma_rad_s, np.nan_to_num(unseen)) + np.nan_to_num(half_range)
    low, high = twin.usable_commands
    valid = (command >= np.maximum(low, twin.off_below)) & (command <= high) & np.isfinite(predicted)
    speeds = {"predicted": predicted, "sigma": band / BAND_SIGMAS, "lower": predicted - band, "upper": predicted + band}
    columns = {
        "time": np.repeat(form.times(t_ns), twin.fans),
        "fan": np.tile(labels(table.fans), len(t_ns)),
        "command": command,
        **{form.speed_column(name): form.in_unit(speed) for name, speed in speeds.items()},
        "valid": valid,
        "reason": np.where(valid, "", InvalidReason.OUT_OF_RANGE.name.lower()).astype(np.object_),
    }
    return {name: values.reshape(-1) for name, values in columns.items()}


def _of_each_fan(values: Any, fans: int) -> Array:
    try:
        given = np.asarray(values, np.float64)
    except (TypeError, ValueError):
        given = np.array(np.nan)
    if given.shape not in ((), (fans,)) or not np.isfinite(given).all():
        raise FantwinError(f"initial_speed_rpm must be a speed, or {fans} speeds, not {values!r}")
    return np.broadcast_to(given, (fans,))
