"""Where no samples came, lines, bands, limits and lanes have a hole."""

from __future__ import annotations

import numpy as np

from fantwin.pipeline.site.trace import SILENT, state_changes, trace_of, with_holes
from fantwin.schemas.messages import Score
from tests.support.score_data import START_NS, STEP_NS, made_up_tray

MISSING_S = (1.0, 2.0)


def scores() -> list[Score]:
    """Four seconds of one fan, of which the second one is missing; a single sample at 3 s is, too."""
    blocks, _ = made_up_tray(seconds=4, fans=1, block=1, faulty_fan=None, gap_fan=None)
    seconds = [(int(block.t_ns[0]) - START_NS) / 1e9 for block in blocks]
    return [b for b, at_s in zip(blocks, seconds, strict=True) if not MISSING_S[0] <= at_s < MISSING_S[1] and at_s != 3]


def test_a_hole_begins_where_samples_begin_to_be_missing_and_one_missing_sample_is_bridged() -> None:
    samples = trace_of("tray1", scores(), "rad/s")
    trace = with_holes(samples, STEP_NS)
    (row,) = np.flatnonzero(np.isnan(trace.predicted[:, 0]))
    assert trace.t_ns[row] == START_NS + 1_000_000_000
    for name in ("measured", "half_width", "balance", "expected_balance", "score"):
        assert np.isnan(getattr(trace, name)[row, 0]) and np.isfinite(np.delete(getattr(trace, name), row)).all(), name
    assert not trace.valid[row, 0] and np.delete(trace.t_ns, row).tolist() == samples.t_ns.tolist()
    times, names = state_changes(trace, 0, "normal")
    assert ((times - START_NS) / 1e9).tolist() == [1.0, 2.0] and names == [SILENT, "normal"]
