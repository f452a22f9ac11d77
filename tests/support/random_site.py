"""A site to which anything happens: kills, requests, silence and losses, drawn at random."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from hypothesis import strategies as st

from fantwin.schemas.enums import Action
from tests.support.killed_site import CHAIN, Site

ASKED = (Action.ACKNOWLEDGE, Action.SHELVE, Action.COMMISSION, Action.OUT_OF_SERVICE)
ANYTHING = {
    "seed": st.integers(0, 1000),
    "raw_samples": st.sampled_from([1, 4, 4]),
    "calibrated": st.booleans(),
    "remembers": st.sampled_from([True, True, False]),
    "events": st.lists(
        st.tuples(st.integers(5, 100), st.sampled_from([*CHAIN, "scorer", "acquisition", "silence", "loss", *ASKED])),
        min_size=2,
        max_size=5,
    ),
}
"""for `given`: the arguments of `random_site` but for the folder"""


def random_site(
    folder: Path,
    seed: int,
    raw_samples: int,
    calibrated: bool,
    remembers: bool,
    events: Sequence[tuple[int, str | Action]],
) -> Site:
    """The site after all events, each of which comes so many samples after the one before."""
    site = Site(folder, seed, raw_samples, calibrated=calibrated, remembers=remembers)
    for samples, event in events:
        site.run(samples)
        if isinstance(event, Action):
            site.ask(event, fan=samples % 4 - 1, duration_s=float(samples % 2))
        elif event == "acquisition":
            site.restart_source()
        elif event == "silence":
            site.fall_silent(0.8)
        elif event == "loss":
            site.loses(1 + samples % 3)
        else:
            site.kill(event)
    site.run(50)
    return site
