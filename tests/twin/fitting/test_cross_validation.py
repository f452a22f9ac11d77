"""A network is used if it improves the prediction of recordings left out, and dropped if it does not."""

import numpy as np
import pytest

from fantwin.twin.fitting.cross_validation import choose_prior_std, simplest_of_the_best
from fantwin.twin.fitting.identification import identify
from fantwin.twin.fitting.training import GRID_PRIOR_STD, data_scaling
from fantwin.twin.models.hybrid import Hybrid
from fantwin.twin.models.network import TanhNetwork
from fantwin.twin.runs import Run
from tests.support import fan_data


def untrained(runs: list[Run]) -> Hybrid:
    return Hybrid(TanhNetwork.zero(10, ("speed", "command"), data_scaling(runs, identify(runs))))


@pytest.mark.slow
def test_a_fan_that_the_physics_describe_gets_no_network_and_a_rough_one_does() -> None:
    plain = [fan_data.published_run(seed, 5.0) for seed in (1, 2)]
    rough = [fan_data.rough_run(seed, 8.0) for seed in (1, 2)]
    assert choose_prior_std(untrained(plain), plain, seed=0) == 0.0
    assert choose_prior_std(untrained(rough), rough, seed=0) > 0.0
    blind = Run("blind", rough[1].t_s, rough[1].command, np.full_like(rough[1].speed_rad_s, np.nan))
    assert choose_prior_std(untrained(rough), [rough[0], blind], seed=0) == GRID_PRIOR_STD, "it does not count"


@pytest.mark.parametrize(
    ("losses", "chosen"),
    [
        ([[5.0, 5.0, 5.0], [4.0, 4.1, 3.9]], 1),
        ([[5.0, 5.0, 5.0], [4.0, 6.0, 4.9]], 0),
        ([[5.0, 5.0, 5.0], [4.0, np.inf, 4.0]], 0),
        ([[np.inf, 9.0, 9.0], [4.0, 4.0, 4.0]], 1),
    ],
)
def test_the_simplest_within_one_standard_error_of_the_best_is_chosen(losses: list, chosen: int) -> None:
    assert simplest_of_the_best(np.array(losses)) == chosen
