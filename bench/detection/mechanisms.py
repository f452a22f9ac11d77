"""The parts of the model that can be left out, and what takes their place; see bench.detection.without."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fantwin.scoring.model.faults import BEFORE_GROWTH
from fantwin.scoring.model.healthy import COUNT, FALL, LATE, RISE, SLOW
from fantwin.scoring.model.population import Priors

Change = Callable[[Any], Any]
NONE = 1e-9
"""standard deviation of what is left out"""


@dataclass(frozen=True)
class Mechanism:
    """One that can be left out. replaced: what stands in for the value at a place, `module:name` or
    `module:class.name`, given that value."""

    name: str
    what: str
    replaced: tuple[tuple[str, Change], ...]


def _with_priors(**of: float) -> tuple[str, Change]:
    """The model of a healthy fan with other priors, whatever it was given."""

    def change(construct: Any) -> Any:
        return lambda model, fans, priors, *times: construct(model, fans, replace(priors, **of), *times)

    return "fantwin.scoring.model.healthy:HealthyFans.__init__", change


def _without_balance(inputs: Any) -> Any:
    return lambda operation, one: inputs(operation, replace(one, balances=np.zeros_like(one.balances)))


def _white_counts(innovation: Any) -> Any:
    """What a count misses is not learned, so the next one is not expected to have it."""

    def changed(model: Any, now: Any) -> Any:
        found = innovation(model, now)
        found.with_states[:, COUNT] = 0.0
        return found

    return changed


def _without_lags(prior: Any) -> Any:
    def changed(*given: Any) -> Any:
        covariance = prior(*given)
        covariance[:, [RISE, FALL, LATE], [RISE, FALL, LATE]] = 0.0
        return covariance

    return changed


def _nothing_given_back(begin: Any) -> Any:
    """The slow states stay as the filter has them when an alarm is raised."""

    def changed(decision: Any, fan: int, *given: Any) -> Any:
        model = decision.model
        mean, covariance = model.mean[fan].copy(), model.covariance[fan].copy()
        begin(decision, fan, *given)
        model.mean[fan, SLOW] = mean[SLOW]
        model.covariance[fan, SLOW, :], model.covariance[fan, :, SLOW] = covariance[SLOW, :], covariance[:, SLOW]

    return changed


def _all_but_outliers(_: Any) -> Any:
    return lambda decision, one, now: np.isfinite(decision.operation.samples_rad_s(one, now)) & ~one.wrong


def _without_growth(faults: Any) -> Any:
    """What remains has the weight of all together."""
    rows = [row for row in faults if row.columns[0] not in BEFORE_GROWTH]
    weight, of_own_drive = sum(row.weight for row in rows), sum(row.of_own_drive for row in rows)
    return tuple(replace(r, weight=r.weight / weight, of_own_drive=r.of_own_drive / of_own_drive) for r in rows)


MECHANISMS: Sequence[Mechanism] = (
    Mechanism(
        "torque-balance",
        "the torque balance in the likelihood: only the speed is compared",
        (("fantwin.scoring.model.operation:Operation.inputs", _without_balance),),
    ),
    Mechanism(
        "counting-error",
        "the counting error as a state: what a count misses is noise, and the next count does not have it",
        (("fantwin.scoring.model.healthy:HealthyFans.innovation", _white_counts),),
    ),
    Mechanism(
        "local-error",
        "the error of a twin that holds while speed and command stay; what was not trained still counts",
        (_with_priors(local_rad_s=NONE),),
    ),
    Mechanism("surroundings", "the air and the sag of the supply", (_with_priors(air=NONE, sag=NONE),)),
    Mechanism("wander", "the wandering of the speed over seconds", (_with_priors(wander=NONE),)),
    Mechanism(
        "lags",
        "errors of the time constants, and how late the tacho is",
        (("fantwin.scoring.model.healthy:_prior", _without_lags), _with_priors(lag_s=NONE)),
    ),
    Mechanism(
        "giving-back",
        "giving back at an alarm what the filter has taken of the fault for the fan's own",
        (("fantwin.scoring.model.decision:Decision._raise", _nothing_given_back),),
    ),
    Mechanism(
        "agreement",
        "far readings wait until others agree; one that is far from all others of its bin still does not count",
        (("fantwin.scoring.model.decision:Decision._counts", _all_but_outliers),),
    ),
    Mechanism("growth", "faults that grow", (("fantwin.scoring.model.decision:FAULTS", _without_growth),)),
    Mechanism(
        "learned-priors",
        "what healthy runs say of the priors: those of a population; the limit is still checked",
        (("fantwin.pipeline.replay.offline.calibration_of_twin:learned_priors", lambda _: lambda _runs: Priors()),),
    ),
)
