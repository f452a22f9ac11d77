"""Small twins for the tests of the stages: real ONNX files, exported with made-up parameters."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import onnx

from fantwin.pipeline.prediction.tray_twin import Balance
from fantwin.schemas.twin_card import (
    CARD_PROPERTY,
    BalanceCard,
    HealthyCard,
    NetworkCard,
    TrainingCard,
    TwinCard,
    ValidationCard,
)
from fantwin.twin.export.onnx_export import export_onnx
from fantwin.twin.fitting.balance_fit import FILTER_RATE_PER_S
from fantwin.twin.models.hybrid import Hybrid
from fantwin.twin.models.model import Model
from fantwin.twin.models.network import Scaling, TanhNetwork
from fantwin.twin.models.physical import PhysicalModel
from fantwin.twin.models.physics import PARAMETER_NAMES

PARAMETERS = (0.15, 0.12, 0.0005, 0.02)
"""J, alpha, C_D, lag_s of a fan that settles within about a second."""
SIGMA_RAD_S = 3.0
SIGMA_COMMAND = 1.0
COVARIANCE = ((1e-6, 0.0, 0.0, 0.0), (0.0, 1e-6, 0.0, 0.0), (0.0, 0.0, 1e-10, 0.0), (0.0, 0.0, 0.0, 0.01))
COMMAND_RANGE = (0.0, 100.0)


def small_hybrid(seed: int = 1) -> Hybrid:
    """Physics and a network with random weights that moves it by some rad/s."""
    inputs = ("speed", "command")
    scaling = Scaling(150.0, 150.0, 50.0, 50.0, 100.0)
    network = TanhNetwork.zero(6, inputs, scaling)
    rng = np.random.default_rng(seed)
    return Hybrid(network.with_theta(rng.normal(0.0, 0.3, network.parameter_count)))


def made_up_card(model: Model, fans: int) -> TwinCard:
    """A card that fits a model, each fan a little different."""
    layout = model.state_layout
    scale = 1.0 + 0.05 * np.arange(fans)
    parameters = tuple(tuple((np.array(PARAMETERS) * s).tolist()) for s in scale)
    unknown = (None,) * fans
    return TwinCard(
        kind=model.kind,
        name=f"made up {model.kind}",
        created="2024-01-01T00:00:00Z",
        fans=fans,
        n_state=layout.size,
        state_layout=layout,
        fixed_rate=model.fixed_rate,
        parameter_names=PARAMETER_NAMES,
        used_parameters=model.used_parameters,
        parameters=parameters,
        identified_parameters=parameters,
        parameter_interval_95=tuple(tuple((value, value) for value in fan) for fan in parameters),
        sigma_rad_s=tuple((SIGMA_RAD_S * scale).tolist()),
        healthy=HealthyCard(unknown, unknown, (), ((),) * fans, unknown),
        balance=made_up_balance(parameters),
        speed_range_rad_s=(0.0, 500.0),
        command_range=COMMAND_RANGE,
        rate_hz=100.0,
        network=NetworkCard(0, (), 0),
        training=TrainingCard("none", "fixed", 0, 0, 0.0, ()),
        validation=ValidationCard("training", (), 0, None, None, None, None, None),
        versions={},
        command_unit="1",
    )


def made_up_balance(parameters: tuple[tuple[float, ...], ...]) -> BalanceCard:
    """The torque balance of fans with these parameters, (fans, 4), and no friction."""
    inertia, viscous, drag, lag_s = zip(*parameters, strict=True)
    each = np.ones(len(parameters))
    return BalanceCard(
        inertia=inertia,
        viscous=viscous,
        drag=drag,
        friction=tuple((0.0 * each).tolist()),
        covariance=(COVARIANCE,) * len(parameters),
        lag_s=lag_s,
        source=("physics",) * len(parameters),
        sigma_command=tuple((SIGMA_COMMAND * each).tolist()),
        autocorrelation_time_s=tuple((0.02 * each).tolist()),
        lowest_speed_rad_s=tuple((20.0 * each).tolist()),
        filter_rate_per_s=FILTER_RATE_PER_S,
    )


def still_balance(fans: int) -> Balance:
    """made_up_balance in the form that a stage uses."""
    return Balance.from_card(made_up_balance((PARAMETERS,) * fans), fans)


def write_twin(path: Path, model: Model | None = None, fans: int = 1, **changes: Any) -> Path:
    """Write a twin. `changes` go into the card as it lies in the file, unchecked; None removes a key."""
    model = model or PhysicalModel()
    file = onnx.load_model_from_string(export_onnx(model, made_up_card(model, fans)))
    properties = {entry.key: entry.value for entry in file.metadata_props}
    card = json.loads(properties[CARD_PROPERTY]) | changes
    properties[CARD_PROPERTY] = json.dumps({key: value for key, value in card.items() if value is not None})
    onnx.helper.set_model_props(file, properties)
    path.write_bytes(file.SerializeToString())
    return path
