"""The assessment of a report in sentences: one headline, and a warning for each thing a reader should know."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np

from fantwin.schemas.model_uncertainty import ModelUncertainty
from fantwin.schemas.twin_card import AS_DECLARED, LOOSER, DataCard, DriveCard
from fantwin.twin.report.content import FanSummary, Summary
from fantwin.twin.report.steady_states import StaticCurve

LEAST_RATIO = 1.5
"""to the standard deviation where the twin was trained: more data of the same kind hardly reduce a smaller one"""


@dataclass(frozen=True)
class LeastKnown:
    """A speed, rad/s, and a command at which the twin may be most wrong, rad/s; held: the fan settles there."""

    speed_rad_s: float
    command: float
    std_rad_s: float
    held: bool


def least_known(known: ModelUncertainty, curve: StaticCurve, drive: DriveCard | None) -> LeastKnown | None:
    """The held command, or else the step from one settled speed, at which the twin may be most wrong.

    It is what to record next: there more data narrow the error of the twin most.

    known, curve, drive: of the fan; curve over the commands that are possible. None: nothing within these commands is
    much less known than what training has seen.
    """
    settled = curve.twin[np.isfinite(curve.twin).all(axis=1)]
    if not len(settled):
        return None
    commands, speeds_rad_s = settled.T
    raised = drive.raised(commands[:, np.newaxis])[:, 0] if drive else commands
    of_steps = known.over(speeds_rad_s, raised)
    of_holds = np.diag(of_steps)
    least = LEAST_RATIO * known.seen_std_rad_s[0]
    if of_holds.max() >= least:
        at = int(of_holds.argmax())
        return LeastKnown(float(speeds_rad_s[at]), float(commands[at]), float(of_holds[at]), held=True)
    start, end = np.unravel_index(int(of_steps.argmax()), of_steps.shape)
    if of_steps[start, end] < least:
        return None
    return LeastKnown(float(speeds_rad_s[start]), float(commands[end]), float(of_steps[start, end]), held=False)


Level = Literal["as declared", "looser than declared", "not followed", "not tested"]

WORSE: dict[Level, str] = {
    "not followed": "does not follow {}",
    "looser than declared": "follows {} less closely than its card says",
}
RATE_TOLERANCE = 0.01
UNCERTAIN = 1.0
"""A parameter is poorly determined when half its 95 % interval is wider than this share of its value."""
OFTEN_MISSING = 0.1
ANOTHER_UNIT = 3.0  # times the top speed of training: numbers in rpm taken for rad/s are ten times too large
CHANCE_PEAK = 2.0
BIASED_IN_SIGMA, BIASED_IN_ERRORS = 0.2, 3.0
BIASED_AT_A_SPEED_IN_SIGMA = 1.0
WIDE_BAND = 1.5
"""A card's sigma is wide when it exceeds the standard deviation of the errors by this factor."""
FEW_INDEPENDENT = 0.5 / (AS_DECLARED - 1.0) ** 2
"""With fewer independent errors the rmse is less certain (1 / sqrt(2 n)) than the margin of `as declared`."""


@dataclass(frozen=True)
class Assessment:
    """The level, the headline and the warnings, one line each."""

    level: Level
    headline: str
    warnings: tuple[str, ...]


def assess(content: Summary) -> Assessment:
    """The assessment by the worst fan."""
    for level, sentence in WORSE.items():
        if worse := [fan for fan in content.fans if level_of(fan, content) == level]:
            what = sentence.format(_these(worse, content))
            return Assessment(level, f"The twin {what}: rmse {_worst(worse)}.", warnings(content))
    if seen := [data.name for used in _made_from(content).values() for data in used]:
        headline = f"Not tested: {', '.join(dict.fromkeys(seen))} made this twin; evaluate it on other recordings."
        return Assessment("not tested", headline, warnings(content))
    who = "this fan" if len(content.fans) == 1 else f"all {len(content.fans)} fans"
    return Assessment("as declared", f"The twin follows {who} as closely as its card says.", warnings(content))


def level_of(fan: FanSummary, content: Summary) -> Level:
    """The level of one fan; `not followed` where the free run diverged or is undefined, and `not tested` where it would
    be as declared, but by recordings from which the twin was made."""
    if fan.rmse_in_sigma <= AS_DECLARED:
        return "not tested" if any(_made_from(content).values()) else "as declared"
    return "looser than declared" if fan.rmse_in_sigma <= LOOSER else "not followed"


def warnings(content: Summary) -> tuple[str, ...]:
    """One line for each thing a reader should know before trusting the figures."""
    concerned = ((sentence, list(filter(concerns, content.fans))) for concerns, sentence in _about_fans(content))
    of_fans = (f"{_these(fans, content).capitalize()}: {sentence}." for sentence, fans in concerned if fans)
    return (*_about_the_data(content), *of_fans)


def _made_from(content: Summary) -> dict[str, list[DataCard]]:
    """The recordings with samples from which the twin was made, by what these were used for."""
    card = content.card
    used = {"in training": card.training.data, "to choose the model and its band": card.validation.data}
    if not set(card.fan_numbers) & {fan.number for fan in content.fans}:
        return {}
    return {how: [own for own in content.recordings if any(map(own.overlaps, data))] for how, data in used.items()}


def _about_the_data(content: Summary) -> Iterator[str]:
    card = content.card
    fastest_rad_s = float(np.nanmax([0.0, *(fan.fastest_rad_s for fan in content.fans)]))
    if fastest_rad_s > ANOTHER_UNIT * card.top_speed_rad_s > 0.0:
        fastest, known = (f"{value / content.unit.rad_s:,.0f}" for value in (fastest_rad_s, card.top_speed_rad_s))
        yield f"Speeds up to {fastest} {content.unit.name}, the twin knows {known}: is the recording's unit right?"
    for how, seen in _made_from(content).items():
        if seen:
            yield f"{', '.join(data.name for data in seen)}: used {how}, so these figures are too favourable."
    if card.validation.source == "training":
        yield "The band is the error over the training data, so it may be too narrow: train with --validate."
    if few := [n for n in card.healthy.independent_samples if n is not None and n < FEW_INDEPENDENT]:
        yield (
            f"The band is estimated from the equivalent of {min(few):.0f} independent errors: its sigma may be off by "
            f"{_uncertainty(min(few)):.0%}; validate on longer recordings."
        )
    if card.fans == 1 and len(content.fans) > 1:
        yield f"A twin of one fan is used for {len(content.fans)}: fans differ, and so may their errors."
    low, high = card.command_range
    outside = np.mean([fan.outside_share for fan in content.fans])
    if outside > 0.0:
        yield (
            f"{outside:.1%} of the commands lie outside the trained range {low:.4g} to {high:.4g} {card.command_unit}"
            .rstrip() + ": there the twin extrapolates."
        )  # fmt: skip
    if card.fixed_rate and abs(content.rate_hz / card.rate_hz - 1.0) > RATE_TOLERANCE:
        yield (
            f"This twin is valid at {card.rate_hz:.4g} Hz only and was run at {content.rate_hz:.4g} Hz: "
            "these figures are meaningless."
        )


def _about_fans(content: Summary) -> Iterator[tuple[Callable[[FanSummary], bool], str]]:
    """Whether something is to be said of a fan, and what."""
    fewest = min((_independent(fan) for fan in content.fans if _few(fan)), default=1.0)
    yield lambda fan: fan.missing_share > OFTEN_MISSING, "more than a tenth of the speeds are missing"
    yield _unmeasured, "no speed was measured"
    yield _diverged, "the free run diverges"
    wide = f"the card's sigma is over {WIDE_BAND:g} times the standard deviation of the errors"
    yield lambda fan: fan.sigma_rad_s > WIDE_BAND * fan.error_std_rad_s, f"{wide}: the assessment is too favourable"
    certain = f"{fewest:.0f} independent errors determine the rmse to {_uncertainty(fewest):.0%} only"
    yield _few, f"{certain}; use longer recordings"
    yield lambda fan: _biased(fan) and fan.residual.mean_rad_s > 0.0, "on average faster than the twin"
    yield lambda fan: _biased(fan) and fan.residual.mean_rad_s < 0.0, "on average slower than the twin"
    at_speeds = "the mean error exceeds sigma at some speeds, as the report shows (Error over speed)"
    yield _biased_at_a_speed, at_speeds
    misses = "the error correlates with the command: the twin misses part of its effect"
    yield lambda fan: abs(fan.residual.cross_over_bound) > CHANCE_PEAK, misses
    for name in content.card.used_parameters:
        yield partial(_is_negative, name), f"{name} is negative, so physics alone do not describe the fan"
        yield partial(_is_uncertain, name), f"{name} is poorly determined: record more and wider command levels"


def _is_negative(name: str, fan: FanSummary) -> bool:
    return any(its.value < 0.0 for its in fan.parameters if its.name == name)


def _is_uncertain(name: str, fan: FanSummary) -> bool:
    own = [its for its in fan.parameters if its.name == name]
    return any(0.0 < UNCERTAIN * its.value < 0.5 * (its.high - its.low) for its in own)


def _biased_at_a_speed(fan: FanSummary) -> bool:
    return any(abs(part.mean_rad_s) > BIASED_AT_A_SPEED_IN_SIGMA * fan.sigma_rad_s for part in fan.by_speed)


def _unmeasured(fan: FanSummary) -> bool:
    return fan.figures.samples == 0


def _diverged(fan: FanSummary) -> bool:
    return bool(np.isinf(fan.figures.max_error_rad_s))


def _few(fan: FanSummary) -> bool:
    return not (_unmeasured(fan) or _diverged(fan)) and _independent(fan) < FEW_INDEPENDENT


def _independent(fan: FanSummary) -> float:
    """The effective number of independent errors of a fan; 1 where it cannot be estimated."""
    return float(np.nan_to_num(fan.residual.independent_samples, nan=1.0))


def _uncertainty(independent: float) -> float:
    """Relative standard deviation of the root mean square of so many independent normal errors."""
    return float(1.0 / np.sqrt(2.0 * independent))


def _biased(fan: FanSummary) -> bool:
    """Whether the mean error is large relative to sigma and to its standard error."""
    offset = abs(fan.residual.mean_rad_s)
    standard_error = fan.figures.rmse_rad_s / np.sqrt(fan.residual.independent_samples)
    return bool(offset > BIASED_IN_SIGMA * fan.sigma_rad_s and offset > BIASED_IN_ERRORS * standard_error)


def _these(fans: Sequence[FanSummary], content: Summary) -> str:
    if len(content.fans) == 1:
        return "this fan"
    if any(fan.label != f"fan {fan.number}" for fan in fans):
        return ", ".join(fan.label for fan in fans)
    return ("fan " if len(fans) == 1 else "fans ") + ", ".join(str(fan.number) for fan in fans)


def _worst(fans: Sequence[FanSummary]) -> str:
    ratios = [fan.rmse_in_sigma for fan in fans]
    if not np.all(np.isfinite(ratios)):
        return "without limit"
    return ("" if len(fans) == 1 else "up to ") + f"{max(ratios):.2f} times the declared sigma"
