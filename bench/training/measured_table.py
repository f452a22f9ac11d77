"""Four models on every measured set (docs/how-to/datasets.md): free run over what was held out, figures in the set's
own unit.

`to best` is the rmse over that of the best model of the set. FANTWIN_DATA names the folder of the sets.
"""

from __future__ import annotations

import math
from typing import Annotated, Any

import typer

from bench.printing import JsonOption, progress, show
from bench.training.four_models import held_out_figures, trained, trained_in_s
from bench.training.measured_sets import Split, splits
from fantwin.twin.comparison import Contender
from fantwin.twin.kinds import KINDS


def main(
    only: Annotated[str, typer.Option(help="Only sets whose name begins so.")] = "",
    seed: Annotated[int, typer.Option(help="Seed of the initial weights.")] = 0,
    json_output: JsonOption = False,
) -> None:
    """Print, for each measured set, the free-run error of each model over runs or parts held out."""
    rows: dict[bool, list[dict[str, Any]]] = {True: [], False: []}
    notes = []
    for split in splits():
        if not split.name.startswith(only):
            continue
        learned = []
        for kind in KINDS:
            progress(f"{split.name} ({split.how}): {kind.title}")
            learned.append(trained(kind, split.training, seed))
        rows[split.covered] += _rows(split, learned)
        notes.append(f"{split.name}, held out: {split.how}")
        notes += [
            f"{split.name}: {found.kind.title}: {found.invalid_reason}" for found in learned if found.invalid_reason
        ]
    titles = {True: "held out at levels that training covers", False: "held out beyond the levels of training"}
    show({titles[covered]: found for covered, found in rows.items() if found}, notes, as_json=json_output)


def _rows(split: Split, learned: list[Contender]) -> list[dict[str, Any]]:
    figures = [held_out_figures(one, split.held_out) for one in learned]
    best_rad_s = min(found.rmse_rad_s for found in figures)
    return [
        {
            "set": split.name,
            "model": one.kind.title,
            "rmse": found.rmse_rad_s / split.rad_s_per_unit,
            "unit": split.unit,
            "max error": found.max_error_rad_s / split.rad_s_per_unit,
            "R2": found.r2,
            "to best": found.rmse_rad_s / best_rad_s if math.isfinite(best_rad_s) else math.nan,
            "trained in s": round(trained_in_s(one), 1),
        }
        for one, found in zip(learned, figures, strict=True)
    ]


if __name__ == "__main__":
    typer.run(main)
