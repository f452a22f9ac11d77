"""A simulated tray as a run for the model maker."""

from __future__ import annotations

import numpy as np

from fantwin.simulation.tray import SimulatedTray, TraySettings
from fantwin.twin.runs import Run


def run_of(settings: TraySettings) -> Run:
    """All samples until the end, lost ones too, at their true times, with the columns that are measured.

    The readings are those of the tachos of the settings.
    """
    tray, samples = SimulatedTray(settings), []
    while tray.due_s() is not None:
        samples.append(tray.take())
    return Run(
        f"seed {settings.seed}",
        np.array([sample.t_s for sample in samples]),
        np.stack([sample.command for sample in samples]),
        np.stack([sample.speed_rad_s for sample in samples]),
        settings.tacho.measurement,
        {name: np.stack([sample.auxiliary[name] for sample in samples]) for name in samples[0].auxiliary},
    )
