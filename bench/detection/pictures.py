"""The picture of docs/explanation/deciding.md: a filter that clogs, what is expected of its fan, score and causes.

The demo's tray runs on a command that moves in small steps. From CLOGS_FROM_S on the drag of one fan grows. Its twin
and its scorer run as on a site, without a bus. Colours are those of `fantwin view`.

Example: python -m bench.detection.pictures docs/explanation/deciding.png
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import matplotlib as mpl
import numpy as np
import typer
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

sys.path.insert(0, str(Path(__file__).parents[2]))

from bench.detection.plant import START_NS
from fantwin.pipeline.outputs.rerun.band_plot import BESIDE, FAULT, MEASURED, OUTSIDE, TWIN
from fantwin.pipeline.prediction.tray_integrator import TrayIntegrator, TwinIntegratorConfig
from fantwin.pipeline.prediction.tray_twin import load_tray_twin
from fantwin.pipeline.prediction.twin_file import TwinFile
from fantwin.pipeline.tray_scoring.healthy_twin import known_of
from fantwin.pipeline.tray_scoring.scorer_config import ScorerConfig
from fantwin.pipeline.tray_scoring.tray_scorer import TrayScorer
from fantwin.schemas.enums import Transition
from fantwin.schemas.messages import Array, Grid
from fantwin.schemas.units import NS_PER_S, RAD_S_PER_UNIT
from fantwin.scoring.alarms.alarm_text import AlarmText
from fantwin.scoring.diagnosis.causes import MIN_PROBABILITY, short_name
from fantwin.scoring.model.healthy import FAULT as FAULT_STATE
from fantwin.simulation.faults import Fault
from fantwin.simulation.tray import SimulatedTray, TraySettings

DEMO_TWIN = Path(__file__).parents[2] / "pipeline" / "demo" / "twin.onnx"
FAN, FANS, SEED = 2, 8, 11
RATE_HZ, BIN_S = 100.0, 0.1
SHOWN_FROM_S, CLOGS_FROM_S, END_S = 20.0, 60.0, 150.0
CLOGS_PER_S = 0.003
"""growth of the drag, each second"""
COMMANDS, HELD_S = (0.55, 0.6, 0.5, 0.65), 15.0
"""commands, one after the other"""
RPM = RAD_S_PER_UNIT["rpm"]
SIGMAS = 2.0
CAUSE_COLORS = (TWIN, BESIDE, "#b06a00", "#8a5aa8")
SIZE_IN, DOTS_PER_INCH = (9.0, 7.2), 110
STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e6e6e6",
    "axes.axisbelow": True,
    "legend.frameon": False,
}


@dataclass(frozen=True, eq=False)
class Seen:
    """What is drawn of the fan, a row for each bin: all (bins,) but causes. Speeds in rad/s."""

    t_s: Array
    measured_rad_s: Array
    predicted_rad_s: Array
    expected_rad_s: Array
    """the twin, and what is expected of this fan beside it"""
    expected_std_rad_s: Array
    score: Array
    causes: dict[str, Array]
    """their probabilities; NaN without an alarm"""
    raised_s: float
    """NaN: there was no alarm"""


def main(output: Annotated[Path, typer.Argument(metavar="OUT.png")]) -> None:
    """Simulate the fan and draw the picture."""
    seen = simulated()
    with mpl.rc_context(STYLE):
        figure = drawn(seen)
        FigureCanvasAgg(figure)
        figure.savefig(output, dpi=DOTS_PER_INCH, metadata={"Software": None})
    print(f"clogs from {CLOGS_FROM_S:g} s, alarm at {seen.raised_s:g} s: {output}")


def simulated() -> Seen:
    """The run of the tray, as its scorer sees the fan."""
    file, card = TwinFile.load(DEMO_TWIN, FANS), load_tray_twin(DEMO_TWIN, FANS)
    integrator = TrayIntegrator(file, TwinIntegratorConfig())
    scorer = TrayScorer(FANS, AlarmText("rpm", ""), ScorerConfig(), known_of(card))
    tray = SimulatedTray(TraySettings(fans=FANS, duration_s=END_S, seed=SEED, jitter_us=0.0, faults=_clogging()))
    rows: list[tuple[float, ...]] = []
    causes: list[dict[str, float]] = []
    raised_s = np.nan
    while grid := _next_grid(tray):
        integrator.begin(grid.period_ns, is_of_another_session=False)
        prediction = integrator.predict(grid)
        score, alarms = scorer.score(prediction)
        t_s = float(grid.t_ns[-1] - START_NS) / NS_PER_S
        for alarm in alarms:
            if alarm.fan == FAN and alarm.transition == Transition.RAISED:
                raised_s = t_s
        predicted = float(score.predicted_speed_rad_s[:, FAN].mean())
        expected, std = _expected(scorer)
        measured = float(np.nanmean(score.measured_speed_rad_s[:, FAN]))
        rows.append((t_s, measured, predicted, predicted + expected, std, float(score.score[-1, FAN])))
        causes.append({one.cause: one.probability for one in scorer._decision.alarms.causes(FAN)})
    t_s, measured, predicted, expected, std, score = np.array(rows).T
    names = dict.fromkeys(name for one in causes for name in one)
    probabilities = {name: np.array([one.get(name, np.nan) for one in causes]) for name in names}
    return Seen(t_s, measured, predicted, expected, std, score, probabilities, raised_s)


def _clogging() -> tuple[Fault, ...]:
    """A drag that grows, in steps of a second."""
    seconds = np.arange(CLOGS_FROM_S, END_S)
    return tuple(Fault("inlet", FAN, t_s, t_s + 1.0, 1.0 + CLOGS_PER_S * (t_s + 1.0 - CLOGS_FROM_S)) for t_s in seconds)


def _next_grid(tray: SimulatedTray) -> Grid | None:
    """The samples of a bin; None at the end."""
    samples = []
    while len(samples) < round(BIN_S * RATE_HZ) and (due_s := tray.due_s()) is not None:
        tray.command(np.full(FANS, COMMANDS[int(due_s / HELD_S) % len(COMMANDS)]))
        samples.append(tray.take())
    if not samples:
        return None
    speed = np.stack([sample.speed_rad_s for sample in samples])
    return Grid(
        fans=FANS,
        period_ns=round(NS_PER_S / RATE_HZ),
        t_ns=START_NS + np.array([round(sample.t_s * NS_PER_S) for sample in samples]),
        command=np.stack([sample.command for sample in samples]),
        speed_rad_s=speed,
        valid=np.ones(speed.shape, np.bool_),
        invalid_reason=np.zeros(speed.shape, np.uint8),
    )


def _expected(scorer: TrayScorer) -> tuple[float, float]:
    """Expected distance of a healthy fan from its twin, rad/s, and its standard deviation."""
    model = scorer._decision.model
    steady, covariance = model.steady[FAN, :FAULT_STATE], model.covariance[FAN, :FAULT_STATE, :FAULT_STATE]
    return float(model.expected_rad_s[FAN]), float(np.sqrt(steady @ covariance @ steady))


def drawn(seen: Seen) -> Figure:
    """The three panels."""
    figure = Figure(SIZE_IN, layout="constrained")
    speed, score, causes = figure.subplots(3, 1, sharex=True, height_ratios=(1.4, 1.2, 1.0))
    _draw_speed(speed, seen)
    _draw_score(score, seen)
    _draw_causes(causes, seen)
    for axes in (speed, score, causes):
        axes.axvline(CLOGS_FROM_S, color=FAULT, lw=1.0, ls=(0, (4, 3)))
        axes.axvline(seen.raised_s, color=OUTSIDE, lw=1.0)
    causes.set_xlim(SHOWN_FROM_S, END_S)
    causes.set_xlabel("time (s)")
    figure.align_ylabels()
    return figure


def _draw_speed(axes: Axes, seen: Seen) -> None:
    shown = seen.t_s >= SHOWN_FROM_S
    t_s, expected, width = seen.t_s[shown], seen.expected_rad_s[shown], SIGMAS * seen.expected_std_rad_s[shown]
    axes.plot(t_s, seen.measured_rad_s[shown] / RPM, color=MEASURED, lw=0.9, label="measured")
    axes.plot(t_s, seen.predicted_rad_s[shown] / RPM, color=TWIN, lw=1.2, ls=(0, (4, 2)), label="twin")
    low, high = (expected - width) / RPM, (expected + width) / RPM
    axes.fill_between(t_s, low, high, color=BESIDE, alpha=0.25, lw=0, label="expected of this fan, ± 2 sigma")
    axes.plot(t_s, expected / RPM, color=BESIDE, lw=0.9)
    axes.set_ylabel("speed (rpm)")
    axes.legend(loc="lower left", bbox_to_anchor=(0, 1.0), ncols=3, borderaxespad=0.0)


def _draw_score(axes: Axes, seen: Seen) -> None:
    axes.plot(seen.t_s, seen.score, color=MEASURED, lw=1.2)
    axes.axhline(1.0, color=OUTSIDE, lw=1.0, ls=(0, (1, 1.5)))
    axes.text(SHOWN_FROM_S + 1.0, 1.06, "limit", color=OUTSIDE)
    axes.text(CLOGS_FROM_S - 1.0, 1.8, "begins to clog", color=FAULT, ha="right")
    axes.text(seen.raised_s + 1.0, 0.1, f"alarm, {seen.raised_s - CLOGS_FROM_S:.0f} s later", color=OUTSIDE)
    axes.set_ylim(bottom=0.0)
    axes.set_ylabel("score")


def _draw_causes(axes: Axes, seen: Seen) -> None:
    highest = {name: float(np.nanmax(share)) for name, share in seen.causes.items()}
    listed = [name for name in sorted(highest, key=highest.__getitem__)[::-1] if highest[name] >= MIN_PROBABILITY]
    for name, color in zip(listed, CAUSE_COLORS, strict=False):
        axes.plot(seen.t_s, 100.0 * seen.causes[name], color=color, lw=1.5, label=short_name(name))
    axes.set_ylim(0.0, 100.0)
    axes.set_ylabel("probability (%)")
    axes.legend(loc="upper left", bbox_to_anchor=(0.0, 1.0))


if __name__ == "__main__":
    typer.run(main)
