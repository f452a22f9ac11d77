"""Twin integrator: runs the healthy twin on the same commands as the fans.

Reads: topic `grid` (command, measured speed rad/s, uniform time), and `new_twin` where the configuration names no twin
(pipeline.prediction.learned_integrator).
Writes: topic `prediction` (measured and predicted speed rad/s, sigma rad/s), and `twin` (the model card) at start and
when a new twin takes over.
Timing: one prediction message for every grid message, immediately, in a process of many trays at its next tick; of
messages that wait together, one. The graph runs once for all fans of a message, or of many trays. Where a new twin
names a sample within a message as its first, there is one prediction for each twin.

The prediction is a *free run*: it starts from the mean of the first measured speeds and is never corrected by a
measurement again. It needs no readings, so a missing one does not disturb it. While no samples arrive, the last
command is held for half a second; then the free run ends, and a new one starts when samples arrive again. Samples are
not valid in the first `warm_up_s` of a free run (WARMING_UP), nor in the first `warm_up_s` after a command that was out
of the twin's range or too small to turn the rotor (OUT_OF_RANGE).

Where the card says how fans stop and start (schemas.standstill), nothing is predicted for a fan that its command stops
(STOPPED). Its free run ends, and the next one starts from measured speeds once it turns; until that has settled,
samples are not valid (STARTING).

Where the card states the conditions for which the twin holds (schemas.reference_conditions), commands are converted to
that supply voltage, and speeds to that density of the air. A value that is missing is held, the voltage for 5 s, the
temperature for 5 minutes; then samples are not valid (CONDITIONS_UNKNOWN), and warm up again when it is back.

The *torque balance* is computed as well: the command given minus the command that a healthy fan needs for the
measured motion. It needs no free run and is available a third of a second after the first sample
(scoring.torque_balance).
"""

from __future__ import annotations

from collections.abc import Mapping

from fantwin.pipeline.config.registry import STAGES
from fantwin.pipeline.errors import refusals
from fantwin.pipeline.prediction.joint_tray_integrator import JointTrayIntegrator
from fantwin.pipeline.prediction.learned_integrator import LearnedTwinIntegrator
from fantwin.pipeline.prediction.new_samples import NewSamples
from fantwin.pipeline.prediction.tray_integrator import TrayIntegrator, TwinIntegratorConfig
from fantwin.pipeline.prediction.twin_file import TwinFile, load_twin
from fantwin.pipeline.runtime.stage import Admitted, BuiltStage, Context, Core, Stage
from fantwin.schemas.fan_names import NO_NAMES, FanNames
from fantwin.schemas.messages import Grid, Message, ModelCard, NewTwin
from fantwin.schemas.units import NS_PER_S

RATE_TOLERANCE = 0.01  # a card holds the measured rate


class TwinIntegratorCore(Core):
    """The twin of one tray."""

    def __init__(
        self,
        twin: TwinFile,
        config: TwinIntegratorConfig,
        started_t_ns: int,
        *,
        content: bytes = b"",
        names: FanNames = NO_NAMES,
    ) -> None:
        """content: of the file of a learned twin, published with its card."""
        self._twin = twin
        self.tray = TrayIntegrator(twin, config, names)
        self._producer: str | None = None  # of the newest grid
        self._card = [
            ModelCard(
                t_ns=started_t_ns,
                twin=twin.card.name,
                kind=twin.card.title,
                sha256=twin.sha256,
                sigma_rad_s=twin.sigma_rad_s,
                card_json=twin.card_json,
                content=content,
            )
        ]
        self._problem = ""
        self._samples = NewSamples(twin.fans, "grid samples", "twin_integrator and scorer")

    def step(self, item: Grid | NewTwin) -> list[Message]:
        """Predict the speeds of a block."""
        admitted = self.admit(item)
        if admitted.block is None:
            return list(admitted.before)
        return [*admitted.before, self.tray.predict(admitted.block)]

    def admit(self, item: Grid | NewTwin) -> Admitted:
        """See Core. The twin is that of the configuration: no other one takes over."""
        if isinstance(item, NewTwin):
            return Admitted([])
        messages: list[Message] = [*self.tick(0)]
        if not self._samples.fits(item):
            return Admitted(messages)
        self._problem = ""
        grid = self._samples.take(item)
        if grid is None:
            return Admitted(messages)
        # each session of the resampler maps the clock of the device anew: its times may differ by tens of
        # milliseconds, as if the speed had jumped
        is_of_another_session = self._producer not in (None, grid.header.producer)
        self.tray.begin(grid.period_ns, is_of_another_session=is_of_another_session)
        self._producer = grid.header.producer
        card = self._twin.card
        if card.fixed_rate and abs(grid.period_ns * card.rate_hz / NS_PER_S - 1) > RATE_TOLERANCE:
            self._problem = (
                f"twin {card.name} is valid at {card.rate_hz:g} Hz only, the grid has "
                f"{NS_PER_S / grid.period_ns:g} Hz: set [resampler] rate_hz = {card.rate_hz:g}"
            )
            return Admitted([*messages, self.tray.without_twin(grid)])
        return Admitted(messages, grid, self.tray.joint_key(grid))

    def tick(self, now_ns: int) -> list[ModelCard]:
        """Publish the model card once."""
        card, self._card = self._card, []
        return card

    def counters(self) -> Mapping[str, int]:
        """docs/explanation/prediction.md explains each counter."""
        return {**self._samples.counters(), **self.tray.counters()}

    def notes(self) -> list[str]:
        """Note on the columns that the twin needs."""
        conditions = self._twin.card.conditions
        return [f"twin {self._twin.card.name} allows for {conditions.in_words}"] if conditions else []

    def problem(self) -> str:
        """A twin that does not fit the grid it receives or the supply of its fans, or a grid whose times have gone
        back."""
        return self._samples.problem() or self._problem or self._problem_of_columns() or self.tray.problem()

    def _problem_of_columns(self) -> str:
        missing, name = self.tray.missing_columns, self._twin.card.name
        if not missing:
            return ""
        return f"twin {name} needs {missing}, which the source does not send: send it, or train without it (--ignore)"


def build(context: Context) -> BuiltStage:
    """The core of one tray and its twin; without one in the configuration, of the twins that are learned.

    Raises:
        StageError: the twin cannot be used.
    """
    names = context.tray.names
    if context.tray.twin is None:

        def core_of(twin: TwinFile, first_t_ns: int, content: bytes) -> TwinIntegratorCore:
            return TwinIntegratorCore(twin, context.config, first_t_ns, content=content, names=names)

        return BuiltStage(LearnedTwinIntegrator(context.tray, core_of))
    return BuiltStage(TwinIntegratorCore(load_twin(context), context.config, context.started_t_ns, names=names))


def check(context: Context) -> list[str]:
    """Problems that would keep the twin from being loaded."""
    return [] if context.tray.twin is None else refusals(lambda: load_twin(context))


STAGE = Stage(
    row=STAGES["twin_integrator"],
    about="the healthy twin on the same commands as the fans",
    config=TwinIntegratorConfig,
    build=build,
    joint=JointTrayIntegrator,
    check=check,
)
