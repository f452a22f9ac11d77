"""The report as one self-contained HTML page: inline figures and style, no script, no external files."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files

import numpy as np
from jinja2 import Environment, StrictUndefined
from markupsafe import Markup

from fantwin.schemas.model_uncertainty import ModelUncertainty
from fantwin.schemas.twin_card import AS_DECLARED, LOOSER
from fantwin.twin.evaluation.residual_analysis import SETTLING_S, SIGNIFICANCE
from fantwin.twin.kinds import kind_title
from fantwin.twin.report import figures
from fantwin.twin.report.assessment import Assessment, assess, least_known, level_of
from fantwin.twin.report.content import Content, FanContent
from fantwin.twin.report.steady_states import StaticCurve, static_curve

MOST_FANS_DRAWN = 12
FOUR_DIGITS = ".4g"
UNREASONABLY_LARGE = 1e7

PARAMETER_MEANING = {
    "J": ("J", "inertia, in command s²/rad"),
    "alpha": ("α", "viscous friction, in command s/rad"),
    "C_D": ("C_D", "drag, in command s²/rad²"),
    "lag_s": ("lag", "of the torque behind the command, s"),
    "lowest_command": ("lowest", "lowest command that has an effect, below it the fan keeps its speed"),
    "friction": ("friction", "of the command, does not turn the rotor"),
    "kick_command": ("kick", "command with which the drive starts the rotor"),
    "time_constant_s": ("T", "time constant, s, at least the shortest that the samples show"),
    "unknown_time": ("any time", "1 where commands change at any time between two samples, 0 where with them"),
}
AT_REST_SHARE = 0.01
"""of the top speed: a lower one is at rest"""


@dataclass(frozen=True, eq=False)
class Figure:
    """One drawn figure with its caption. svg: for wide screens and paper; narrow_svg: for phones, where it differs."""

    title: str
    meaning: str
    svg: str
    narrow_svg: str = ""


def report_page(content: Content, assessment: Assessment | None = None, alarms: Sequence[str] = ()) -> str:
    """The page. assessment: by default, that of the content. alarms: what raises one with this twin, in sentences."""
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    environment.filters |= {"shown": shown, "svg": Markup}
    template = environment.from_string(files("fantwin.twin.report").joinpath("page.html").read_text(encoding="utf-8"))
    drawn = drawn_fans(content.fans)
    return template.render(
        content=content,
        card=content.card,
        unit=content.unit.name,
        each=content.unit.rad_s,
        assessment=assessment or assess(content),
        kind=kind_title(content.card.kind),
        parameter_meaning=PARAMETER_MEANING
        | {
            name: (f"at {command:.4g}", f"speed at the command {command:.4g}, rad/s")
            for name, command in zip(content.card.parameter_names[2:], content.card.steady_commands, strict=False)
        },
        physics_used=content.card.used_parameters,
        level_of=level_of,
        refined=any(it.in_force != it.value for fan in content.fans for it in fan.parameters),
        alarms=alarms,
        as_declared=AS_DECLARED,
        looser=LOOSER,
        settling_s=SETTLING_S,
        drawn=drawn,
        figures_of={fan.number: fan_figures(content, fan) for fan in drawn},
    )


def drawn_fans(fans: Sequence[FanContent]) -> list[FanContent]:
    """The fans that get figures, in order: all, or of many those with the largest error in sigma."""

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
            "The free run starts from the measured speed and then gets only the commands. "
            + _how_time_is_drawn(content),
            figures.over_time(content, fan, narrow=False),
            figures.over_time(content, fan, narrow=True),
        ),
        Figure(
            "Around the largest error",
            "The stretch where the twin was furthest off: a step that it follows too slowly, a dropout, or a fault.",
            figures.around_the_largest_error(content, fan),
        ),
        Figure(
            "Histogram of the error",
            "Noise fills the normal curve; a second hump or long tails point to states that the twin does not know, "
            "or to a faulty sensor. Errors beyond the axis are counted at its ends.",
            figures.histogram(content, fan),
        ),
        Figure(
            "Whiteness",
            "The error should not be predictable from its past: beyond the first lags it should stay in the band. "
            f"{_whiteness(fan)}",
            figures.autocorrelation(fan),
        ),
        Figure(
            "Cross-correlation with the command",
            "A peak at a positive lag shows that the twin misses part of the effect of the command; one at a negative "
            "lag shows that the command reacts to the speed (closed loop).",
            figures.cross_correlation(fan),
        ),
        Figure(
            "Static curve",
            f"The speed at which twin and fan settle. {_holds(curve)}",
            figures.static_curve(content, fan, curve),
        ),
        Figure(
            "Error over speed",
            "Points off the zero line are speeds at which the twin is biased; long bars speeds of large scatter.",
            figures.error_over_speed(content, fan),
        ),
        *_what_is_known(content, fan, curve),
    ]


def _what_is_known(content: Content, fan: FanContent, curve: StaticCurve) -> list[Figure]:
    if content.card.model_uncertainty is None:
        return []
    known = content.card.model_uncertainty.of_fans([fan.row])
    std_rad_s = known.std_at(fan.predicted_rad_s[:, np.newaxis], fan.raised_command[:, np.newaxis])
    beyond = std_rad_s[np.isfinite(std_rad_s)] > fan.sigma_rad_s
    share = f" So are {100.0 * beyond.mean():.3g} % of the samples here." if beyond.size else ""
    return [
        Figure(
            "What the twin knows",
            "How far the twin itself may be wrong, because of what it has not seen in training. Outside of the red "
            f"line that is more than the healthy sigma.{share} {_record_next(content, fan, known, curve)}",
            figures.what_is_known(content, fan, known),
        )
    ]


def _record_next(content: Content, fan: FanContent, known: ModelUncertainty, curve: StaticCurve) -> str:
    least = least_known(known, curve, fan.drive)
    if least is None:
        return (
            "At these commands the twin is nowhere much less certain than where it was trained: "
            "more such data hardly reduce its error."
        )
    each, name = content.unit.rad_s, content.unit.name
    unit = f" {content.card.command_unit}" if content.card.command_unit else ""
    speed, std, seen = (
        f"{float(f'{value / each:.3g}'):,g} {name}"
        for value in (least.speed_rad_s, least.std_rad_s, known.seen_std_rad_s[0])
    )
    command = f"{least.command:.3g}{unit}"
    start = "rest" if least.speed_rad_s < AT_REST_SHARE * content.card.top_speed_rad_s else speed
    where = f"the command held at {command}" if least.held else f"steps from {start} to the command {command}"
    return f"What to record next: {where}, where the twin may be wrong by {std} ({seen} where it was trained)."


def _how_time_is_drawn(content: Content) -> str:
    line = content.timeline
    sentences = ["Long recordings are thinned to the extremes of 500 columns, so no excursion is lost."]
    if len(line.recordings) > 1:
        sentences.append("Recordings follow one another.")
    if conditions := content.card.conditions:
        sentences.append(
            f"The twin allows for {conditions.in_words}: commands and speeds are shown as they would be at these."
        )
    if line.gaps:
        longest = max(gap.lasted_s for gap in line.gaps)
        cut = "; long ones are cut short" if any(gap.shortened for gap in line.gaps) else ""
        sentences.append(
            f"Gaps are grey ({len(line.gaps)}, the longest {longest:.4g} s{cut}): the free run starts again after each."
        )
    return " ".join(sentences)


def _holds(curve: StaticCurve) -> str:
    if settled := len(curve.measured):
        return f"{settled} of {len(curve.holds)} holds of the command were long enough to settle."
    if not curve.holds:
        return "The command was never constant, so no measured point can be shown."
    nearest = min(curve.holds, key=lambda hold: hold.needed_s - hold.lasted_s)
    return (
        "No hold of the command was long enough for the fan to settle: the nearest lasted "
        f"{nearest.lasted_s:.2g} s and needed {nearest.needed_s:.2g} s."
    )


def _whiteness(fan: FanContent) -> str:
    p = fan.residual.ljung_box_p
    if math.isnan(p):
        return "Too little was measured to test it."
    found = "Not white" if p < SIGNIFICANCE else "Compatible with white"
    probability = "less than 0.0001" if p < 1e-4 else f"{p:.2g}"
    return f"{found}: over {fan.residual.ljung_box_lags} lags, noise gives such a value with probability {probability}."


def shown(value: float | None, form: str = FOUR_DIGITS) -> str:
    """A number as text; undefined and infinite as words, very large ones with an exponent."""
    if value is None or math.isnan(value):
        return "undefined"
    if math.isinf(value):
        return "infinite"
    if abs(value) >= UNREASONABLY_LARGE and not form.endswith("d"):
        return f"{value:.3g}"
    return f"{value:.0f}" if form == FOUR_DIGITS and abs(value) >= 1e3 else format(value, form)
