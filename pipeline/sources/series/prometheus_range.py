"""Answer of Prometheus to a query over a range, `api/v1/query_range`, saved as JSON."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.sources.series.series_file import Label, SeriesFile, named
from fantwin.schemas.messages import FURTHEST_T_NS
from fantwin.schemas.units import NS_PER_S

MOST_BYTES = 512 << 20


def is_prometheus(start: str) -> bool:
    """Whether a file begins as such an answer."""
    return start.lstrip().startswith("{") and '"resultType"' in start


def read_prometheus_range(path: Path) -> SeriesFile:
    """The series of an answer: `metric{label=value}`, without the labels that all share.

    Raises:
        UserError: it is no such answer.
    """
    try:
        if path.stat().st_size > MOST_BYTES:
            raise UserError(
                f"{path}: larger than {MOST_BYTES >> 20} MiB: ask for a shorter range, and import the files"
            )
        answer: Any = json.loads(path.read_text(encoding="utf-8-sig"))
        results = answer["data"]["result"]
        found = [_series(each) for each in results]
    except (ValueError, TypeError, KeyError, IndexError) as error:
        raise UserError(f"{path}: no answer of Prometheus to a query over a range: {error!r}") from error
    if not found:
        raise UserError(f"{path}: Prometheus found no series: check the query and its range")
    series = named(found)
    return SeriesFile(f"Prometheus, {len(series)} series", series)


def _series(result: Any) -> tuple[Label, Any, Any]:
    labels = {str(key): str(value) for key, value in result["metric"].items()}
    pairs = [(float(time) * NS_PER_S, float(value)) for time, value in result.get("values") or [result["value"]]]
    known = [(time, value) for time, value in pairs if abs(time) < FURTHEST_T_NS and math.isfinite(value)]
    t_ns, values = np.array([round(time) for time, _ in known], np.int64), np.array([value for _, value in known])
    return Label(labels.pop("__name__", ""), tuple(sorted(labels.items()))), t_ns, values
