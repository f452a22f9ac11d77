"""Excerpts of the recordings of the healthy history as training data."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import typer

from fantwin.pipeline.cli.twins.training_data import TrainingData, joined, training_data_of, twin_errors
from fantwin.pipeline.recordings.excerpts import ExcerptReader

MOST_HZ = 100.0
"""samples of faster lines are thinned to at most about this rate, that of the fastest grid by default"""
NEARLY = 0.05
"""a rate that is higher by this share is not thinned"""


@dataclass(frozen=True)
class Excerpt:
    """A part of a recording, in seconds since its first sample."""

    path: Path
    from_s: float
    to_s: float


def read_excerpts(excerpts: Iterable[Excerpt]) -> TrainingData:
    """The samples of excerpts together, those of fast lines thinned. Damage is reported on stderr.

    Raises:
        UserError: they cannot be read, or are not in one unit.
    """
    return joined(list(each_excerpt(excerpts)))


def each_excerpt(excerpts: Iterable[Excerpt]) -> Iterator[TrainingData]:
    """The samples of each excerpt by itself. Raises as `read_excerpts`."""
    path, reader = None, None
    for excerpt in excerpts:
        if reader is None or excerpt.path != path:
            path, reader = excerpt.path, ExcerptReader(excerpt.path)
        found = reader.read(excerpt.from_s, excerpt.to_s)
        if found.damage:
            typer.echo(found.damage, err=True)
        yield _thinned(training_data_of(found))


def _thinned(data: TrainingData) -> TrainingData:
    with twin_errors():
        from fantwin.twin.evaluation.resampling import thinned  # noqa: PLC0415  the command line loads twin only when it is needed

        runs = [thinned(run, every_of(1.0 / run.median_period_s)) for run in data.runs]
    sources = [replace(source, samples=run.samples) for source, run in zip(data.sources, runs, strict=True)]
    return replace(data, runs=runs, sources=sources)


def every_of(rate_hz: float) -> int:
    """Of how many samples of a line one is used."""
    return max(1, math.ceil(rate_hz / MOST_HZ - NEARLY))
