"""The samples of a simulated tray, and a run of them for the model maker."""

from __future__ import annotations

import numpy as np

from fantwin.schemas.device_sample import DeviceSample
from fantwin.simulation.tray import SimulatedTray, TraySettings
from fantwin.twin.runs import Run


def samples_of(settings: TraySettings, duty: float | None = None) -> list[DeviceSample]:
    """All samples until the end. duty: of all fans, instead of the profile."""
    tray, samples = SimulatedTray(settings), []
    if duty is not None:
        tray.command(np.full(settings.fans, duty))
    while tray.due_s() is not None:
        samples.append(tray.take())
    return samples


def run_of(settings: TraySettings, duty: float | None = None) -> Run:
    """All samples until the end, lost ones too, at their true times, with the columns that are measured.

    The readings are those of the tachos of the settings.
    """
    samples = samples_of(settings, duty)
    return Run(
        f"seed {settings.seed}",
        np.array([sample.t_s for sample in samples]),
        np.stack([sample.command for sample in samples]),
        np.stack([sample.speed_rad_s for sample in samples]),
        settings.tacho.measurement,
        {name: np.stack([sample.auxiliary[name] for sample in samples]) for name in samples[0].auxiliary},
    )
