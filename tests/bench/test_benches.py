"""Every bench can be imported: what it takes from the product and from the tests is there."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
OURS = ("bench", "fantwin_client", "pipeline", "schemas", "scoring", "simulation", "stages", "tests", "twin")


def test_every_bench_finds_what_it_imports(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    for path in sorted((ROOT / "bench").rglob("*.py")):
        name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        try:
            importlib.import_module(name)
        except ModuleNotFoundError as error:
            missing = str(error.name).partition(".")[0]
            assert missing not in OURS, f"{name}: {error}"  # others are packages of the extra `bench`


def test_what_the_ablation_leaves_out_exists_and_an_unknown_name_is_refused() -> None:
    without = importlib.import_module("bench.detection.without")
    for mechanism in importlib.import_module("bench.detection.mechanisms").MECHANISMS:
        for place, _ in mechanism.replaced:
            owner, attribute = without.owner_of(place)
            assert attribute in vars(owner), place
    with pytest.raises(without.UnknownMechanismError, match="--without list"), without.without("no-such"):
        pass
