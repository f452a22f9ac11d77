"""A producer and a consumer as a watcher of the site sees them."""

from __future__ import annotations

from dataclasses import replace

from fantwin.pipeline.site.site_watcher import StageView
from fantwin.schemas.health import Health, Input, Output
from fantwin.schemas.units import NS_PER_S
from tests.support.made_messages import health

GRID = "fantwin/s/tray1/grid"
NOW_NS = 1_800_000_000 * NS_PER_S
PRODUCER = health("resampler", t_ns=NOW_NS, uptime_s=100.0, outputs=(Output(key=GRID, published=900),))
CONSUMER = health(
    "twin_integrator",
    t_ns=NOW_NS,
    uptime_s=100.0,
    inputs=(Input(key=GRID, producer="resampler-all-1", received=800, missing=0, duplicated=0, next_sequence=800),),
)


def view(health: Health, *, alive: bool = True, age_s: float = 0.5, published_before: int = 0) -> StageView:
    before = tuple(replace(output, published=published_before) for output in health.outputs)
    return StageView(health, replace(health, outputs=before, t_ns=health.t_ns - NS_PER_S), alive, age_s)
