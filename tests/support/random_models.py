"""Models of each kind whose networks have random weights."""

from __future__ import annotations

import numpy as np

from fantwin.twin.models.narx import PARAMETER_COUNT, Narx
from fantwin.twin.models.network import Scaling, TanhNetwork

SCALING = Scaling(80.0, 90.0, 50.0, 50.0, 300.0)


def random_network(units: int, inputs: tuple[str, ...] = ("speed", "command")) -> TanhNetwork:
    network = TanhNetwork.zero(units, inputs, SCALING)
    return network.with_theta(np.random.default_rng(units).normal(scale=0.3, size=network.parameter_count))


def random_narx() -> Narx:
    return Narx(np.random.default_rng(1).normal(scale=0.1, size=PARAMETER_COUNT), SCALING)
