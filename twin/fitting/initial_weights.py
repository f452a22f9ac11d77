"""Initial weights of the hidden units of a network, before it is trained.

Training of a small network fails mostly because of its start: a unit that is flat over the data never finds the kink
that it is needed for. Where the physics are incomplete is known: friction changes where the rotor comes to rest, and a
drive has its dead zone near zero command. So in every other placement a third of the units are steps in speed near rest
and a third steps in command near zero, both of many widths. All others are smooth and lie anywhere in the data. The
output weights then follow by linear least squares through the filtering operator (twin.fitting.filtering), with the
hidden units as additional regressors. That is cheap enough to draw many placements and keep a few of each sort.
"""

from collections.abc import Callable, Sequence

import numpy as np

from fantwin.twin.fitting.filtering import filtered_regression, with_lagged_command
from fantwin.twin.fitting.identification import Identification
from fantwin.twin.models.fan_ode import NetworkOde
from fantwin.twin.models.network import TanhNetwork
from fantwin.twin.models.physics import LAG
from fantwin.twin.runs import Array, Run

PLACEMENTS = 24
STEEPEST_IN_SPEED, STEEPEST_IN_COMMAND = 40.0, 20.0
RIDGE = 1e-4


def initial_weights(
    model: NetworkOde, pieces: Sequence[Run], identification: Identification, rng: np.random.Generator, keep: int
) -> list[Array]:
    """The best `keep` of many random starts: weights (P,) each, as many with kinks as without, best first."""
    acting = with_lagged_command(pieces, identification.parameters[:, LAG])
    best: list[tuple[Array, float]] = []
    for kinks, count in ((True, keep - keep // 2), (False, keep // 2)):
        drawn = [
            _fit_output_layer(_placed(model, pieces, rng, kinks), acting, identification)
            for _ in range(PLACEMENTS // 2)
        ]
        best += sorted(drawn, key=lambda candidate: candidate[1])[:count]
    return [theta for theta, _ in sorted(best, key=lambda candidate: candidate[1])]


def _placed(model: NetworkOde, pieces: Sequence[Run], rng: np.random.Generator, kinks: bool) -> NetworkOde:
    """Random hidden units; output weights zero. A unit is a direction, a steepness and a centre in scaled inputs."""
    network, scale = model.network, model.network.scaling
    units, third = network.units, network.units // 3 if kinks else 0
    speeds = np.concatenate([piece.speed_rad_s.ravel() for piece in pieces])
    commands = np.concatenate([piece.command.ravel() for piece in pieces])
    known = np.flatnonzero(np.isfinite(speeds))
    chosen = rng.choice(known, size=units)
    centres = np.stack(
        (
            (speeds[chosen] - scale.speed_offset_rad_s) / scale.speed_scale_rad_s,
            (commands[chosen] - scale.command_offset) / scale.command_scale,
        )
    )
    angle_rad = rng.uniform(0.0, 2.0 * np.pi, units)
    slope = _log_uniform(rng, 0.3, 4.0, units)
    in_speed, in_command = slice(third), slice(third, 2 * third)
    rest = np.clip(-scale.speed_offset_rad_s / scale.speed_scale_rad_s, -1.0, 1.0)
    slope[in_speed] = _log_uniform(rng, 2.0, STEEPEST_IN_SPEED, third)
    angle_rad[in_speed] = 0.0
    centres[0, in_speed] = rest + rng.uniform(-1.0, 2.0, third) / slope[in_speed]
    if len(network.inputs) > 1:
        none = np.clip(-scale.command_offset / scale.command_scale, -1.0, 1.0)
        slope[in_command] = _log_uniform(rng, 1.0, STEEPEST_IN_COMMAND, third)
        angle_rad[in_command] = 0.5 * np.pi
        centres[1, in_command] = none + np.sign(0.5 - (none > 0.0)) * 2.0 * rng.uniform(0.0, 1.0, third) ** 2
        directions = np.stack((np.cos(angle_rad), np.sin(angle_rad)))
    else:
        directions, centres = np.ones((1, units)), centres[:1]
    slopes = directions * slope
    bias = -np.sum(slopes * centres, axis=0)
    return model.with_theta(np.concatenate((slopes.ravel(), bias, np.zeros(units + 1))))


def _log_uniform(rng: np.random.Generator, low: float, high: float, size: int) -> Array:
    return np.exp(rng.uniform(np.log(low), np.log(high), size))


def _fit_output_layer(placed: NetworkOde, acting: Sequence[Run], identification: Identification) -> tuple[Array, float]:
    """The weights (P,) with those of the output fitted, and the sum of squares that is left."""
    target, regressors = _output_regression(placed, acting, identification)
    # Random tanh units are close to collinear; the ridge keeps their weights of order one.
    squares = regressors.T @ regressors
    ridge = RIDGE * np.trace(squares) / len(squares) * np.eye(len(squares))
    output = np.linalg.solve(squares + ridge, regressors.T @ target)
    theta = np.concatenate((placed.network.theta[: -len(output)], output))
    return theta, float(np.sum((target - regressors @ output) ** 2))


def _output_regression(model: NetworkOde, acting: Sequence[Run], identification: Identification) -> tuple[Array, Array]:
    """Filtered target (m,), less the known acceleration, and output-layer regressors (m, units + 1) of all fans."""
    targets, regressors = [], []
    lambda_per_s = float(np.median(identification.lambda_per_s))
    for piece in acting:
        for fan in np.flatnonzero(np.isfinite(piece.speed_rad_s).sum(axis=0) >= 2).tolist():
            basis = _output_basis(model, identification.parameters[fan])
            target, columns = filtered_regression(
                piece.t_s, piece.speed_rad_s[:, fan], piece.command[:, fan], basis, lambda_per_s
            )
            targets.append(target - columns[:, 0])
            regressors.append(columns[:, 1:])
    return np.concatenate(targets), np.concatenate(regressors)


def _output_basis(model: NetworkOde, parameters: Array) -> Callable[[Array, Array], Array]:
    """Speed (n,) and command (n,) to the known acceleration, each hidden unit and a constant: (n, units + 2)."""
    network: TanhNetwork = model.network
    rate = network.scaling.acceleration_scale_rad_s2
    known = model.with_theta(np.zeros_like(network.theta)).equation(parameters[np.newaxis])

    def basis(speed_rad_s: Array, command: Array) -> Array:
        without_network = known.acceleration(speed_rad_s[:, np.newaxis], command[:, np.newaxis])
        hidden = network.hidden(speed_rad_s, command)
        return np.column_stack((without_network, rate * hidden, np.full(len(hidden), rate)))

    return basis
