"""What the demo shows while it runs: stages, alarms, and every fan beside its twin."""

from __future__ import annotations

from rich.box import SIMPLE_HEAD
from rich.console import Group
from rich.table import Table
from rich.text import Text

from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.cli.watch.status import stage_table
from fantwin.pipeline.config.models import Config
from fantwin.pipeline.config.roles import roles_of
from fantwin.pipeline.site.site_watcher import SiteWatcher
from fantwin.schemas.codec import decode
from fantwin.schemas.enums import FanState, InvalidReason
from fantwin.schemas.messages import Score
from fantwin.schemas.topics import tray_key
from fantwin.schemas.units import RAD_S_PER_UNIT

_AT_REST = (FanState.STOPPED, FanState.STARTING)
_STYLES = {FanState.NORMAL: "green", FanState.SUSPECT: "yellow", **dict.fromkeys((FanState.UNKNOWN, *_AT_REST), "dim")}


class DemoScreen:
    """Follows a running demo and renders its state."""

    def __init__(self, config: Config, bus: Bus) -> None:
        self._config = config
        self._tray = config.trays[0]
        self._watcher = SiteWatcher(bus, config.site, roles_of(config), config.trays, has_scores=True)
        self._score: Score | None = None
        bus.subscribe(tray_key(config.site, self._tray.name, "score"), self._on_score)

    def _on_score(self, _key: str, payload: bytes) -> None:
        score = decode(Score, payload)
        assert isinstance(score, Score)
        self._score = score

    @property
    def has_score(self) -> bool:
        """Whether a score has arrived."""
        return self._score is not None

    @property
    def fans_in_alarm(self) -> list[int]:
        """Those that the newest score says are in alarm."""
        states = self._score.state[-1] if self._score else ()
        return [fan for fan, state in enumerate(states) if state == FanState.ALARM]

    def render(self) -> Group:
        """Stages, alarms and fans, for a terminal."""
        starting = Text("starting the stages", style="dim")
        stages = stage_table(self._watcher, self._config) if self._watcher.stages() else starting
        return Group(stages, self._fan_table())

    def line(self) -> str:
        """The state of the fans in one line, where there is no terminal."""
        if self._score is None:
            return "waiting for the first score"
        states = [FanState(state) for state in self._score.state[-1]]
        notable = [f"fan {fan} {state.name.lower()}" for fan, state in enumerate(states) if state != FanState.NORMAL]
        if len(notable) == len(states):
            return f"all fans {states[0].name.lower()}" + (" (twins warming up)" if self._warming_up() else "")
        return (", ".join(notable) or "all fans normal") + f"; lost {sum(self._watcher.losses().values())}"

    def _warming_up(self) -> bool:
        return self._score is not None and bool((self._score.invalid_reason[-1] == InvalidReason.WARMING_UP).all())

    def _fan_table(self) -> Table:
        unit = self._tray.speed_unit
        table = Table("fan", title=f"{self._tray.name}, speeds in {unit}", title_justify="left", box=SIMPLE_HEAD)
        for column in ("command", "measured", "twin", "residual"):
            table.add_column(column, justify="right")
        table.add_column("state")
        score = self._score
        if score is None:
            return table
        scale = 1 / RAD_S_PER_UNIT[unit]
        for fan in range(score.fans):
            state = FanState(score.state[-1, fan])
            why = (
                ""
                if score.valid[-1, fan] or state in _AT_REST
                else f" ({InvalidReason(score.invalid_reason[-1, fan]).name.lower().replace('_', ' ')})"
            )
            table.add_row(
                str(fan),
                f"{score.command[-1, fan]:.2f}",
                f"{score.measured_speed_rad_s[-1, fan] * scale:.0f}",
                f"{score.predicted_speed_rad_s[-1, fan] * scale:.0f}",
                f"{score.deviation_rad_s[-1, fan] * scale:+.0f}",
                Text(state.name.lower() + why, style=_STYLES.get(state, "bold red")),
            )
        return table
