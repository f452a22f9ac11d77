"""The report as one HTML page: its figures drawn inside, its style inside, no script and nothing to fetch."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files

import numpy as np
from jinja2 import Environment, StrictUndefined
from markupsafe import Markup

from twin.evaluation.residual_analysis import SIGNIFICANCE
from twin.kinds import kind_title
from twin.report import figures
from twin.report.content import Content, FanContent
from twin.report.steady_states import StaticCurve, static_curve
from twin.report.verdict import AS_DECLARED, LOOSER, Verdict, judge, level_of

MOST_FANS_DRAWN = 12
FOUR_DIGITS = ".4g"
BEYOND_REASON = 1e7

PARAMETER_SAID = {
    "J": ("J", "inertia, in command s²/rad"),
    "alpha": ("α", "viscous friction, in command s/rad"),
    "C_D": ("C_D", "drag, in command s²/rad²"),
    "lag_s": ("lag", "of the torque behind the command, s"),
}


@dataclass(frozen=True, eq=False)
class Figure:
    """One drawn figure with its caption. svg: for wide screens and paper; narrow_svg: for phones, where it differs."""

    title: str
    meaning: str
    svg: str
    narrow_svg: str = ""


def report_page(content: Content, judged: Verdict | None = None) -> str:
    """The page. judged: by default, the verdict on the content."""
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    environment.filters |= {"shown": shown, "svg": Markup}
    template = environment.from_string(files("twin.report").joinpath("page.html").read_text(encoding="utf-8"))
    drawn = drawn_fans(content.fans)
    return template.render(
        content=content,
        card=content.card,
        unit=content.unit.name,
        each=content.unit.rad_s,
        verdict=judged or judge(content),
        kind=kind_title(content.card.kind),
        parameter_said=PARAMETER_SAID,
        physics_used=content.card.used_parameters,
        level_of=level_of,
        refined=any(it.in_force != it.value for fan in content.fans for it in fan.parameters),
        as_declared=AS_DECLARED,
        looser=LOOSER,
        drawn=drawn,
        figures_of={fan.number: fan_figures(content, fan) for fan in drawn},
    )


def drawn_fans(fans: Sequence[FanContent]) -> list[FanContent]:
    """The fans that get figures: all, or of many the worst by their error in sigma, in the recording's order."""

    def error(fan: FanContent) -> float:
        return math.inf if math.isnan(fan.rmse_in_sigma) else fan.rmse_in_sigma

    worst = sorted(fans, key=error, reverse=True)[:MOST_FANS_DRAWN]
    return sorted(worst, key=lambda fan: fan.number)


def fan_figures(content: Content, fan: FanContent) -> list[Figure]:
    """The figures of one fan, the one over time first."""
    curve = static_curve(
        content.twin,
        np.array([parameter.in_force for parameter in fan.parameters]),
        content.pieces,
        fan.column,
        content.card.rate_hz,
        content.card.speed_range_rad_s[1],
    )
    return [
        Figure(
            "Fit and error over time",
            "The free run starts from the measured speed and then knows the commands alone. "
            + _how_time_is_drawn(content),
            figures.over_time(content, fan, narrow=False),
            figures.over_time(content, fan, narrow=True),
        ),
        Figure(
            "Around the largest error",
            "What happened where the twin was furthest off: a step that it takes too slowly, a dropout, or a fault.",
            figures.around_the_largest_error(content, fan),
        ),
        Figure(
            "Histogram of the error",
            "Errors that are noise fill the normal curve; a second hump or long tails are states that the twin does "
            "not know, or a sensor that slips. Errors beyond the axis are counted at its ends.",
            figures.histogram(content, fan),
        ),
        Figure(
            "Whiteness",
            "What is left should not be foreseeable from its own past: beyond the first lags it should stay in the "
            f"band. {_whiteness(fan)}",
            figures.autocorrelation(fan),
        ),
        Figure(
            "Cross-correlation with the command",
            "A peak at a positive lag says that the twin misses a part of what the command does; one at a negative "
            "lag says that the command answers the speed (closed loop).",
            figures.cross_correlation(fan),
        ),
        Figure(
            "Static curve",
            f"The speed at which twin and fan settle. {_holds(curve)}",
            figures.static_curve(content, fan, curve),
        ),
        Figure(
            "Error over speed",
            "Points off the zero line are speeds at which the twin is biased; long bars those at which it is loose.",
            figures.error_over_speed(content, fan),
        ),
    ]


def _how_time_is_drawn(content: Content) -> str:
    line = content.timeline
    said = ["Long recordings are thinned to the extremes of 500 columns, so no excursion is lost."]
    if len(line.recordings) > 1:
        said.append("Recordings follow one another.")
    if line.gaps:
        longest = max(gap.lasted_s for gap in line.gaps)
        cut = "; long ones are cut short" if any(gap.shortened for gap in line.gaps) else ""
        said.append(f"Gaps are grey ({len(line.gaps)}, the longest {longest:.4g} s{cut}): the free run starts anew.")
    return " ".join(said)


def _holds(curve: StaticCurve) -> str:
    if settled := len(curve.measured):
        return f"{settled} of {len(curve.holds)} holds of the command were long enough to settle."
    if not curve.holds:
        return "The command never held still, so nothing measured can be shown."
    nearest = min(curve.holds, key=lambda hold: hold.needed_s - hold.lasted_s)
    return (
        "No hold of the command was long enough for the fan to settle: the one that came nearest lasted "
        f"{nearest.lasted_s:.2g} s and needed {nearest.needed_s:.2g} s."
    )


def _whiteness(fan: FanContent) -> str:
    p = fan.residual.ljung_box_p
    if math.isnan(p):
        return "Too little was measured to test it."
    found = "Not white" if p < SIGNIFICANCE else "Nothing speaks against white"
    probability = "less than 0.0001" if p < 1e-4 else f"{p:.2g}"
    return f"{found}: noise does as much over {fan.residual.ljung_box_lags} lags with probability {probability}."


def shown(value: float | None, form: str = FOUR_DIGITS) -> str:
    """A number for people, with an exponent only beyond reason; what is undefined or infinite is said in words."""
    if value is None or math.isnan(value):
        return "undefined"
    if math.isinf(value):
        return "infinite"
    if abs(value) >= BEYOND_REASON and not form.endswith("d"):
        return f"{value:.3g}"
    return f"{value:.0f}" if form == FOUR_DIGITS and abs(value) >= 1e3 else format(value, form)
