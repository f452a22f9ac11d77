"""`fantwin up --only`: a stage alone says what is wrong with it, as `fantwin up` does for all stages."""

from __future__ import annotations

from fantwin.pipeline.cli.watch import one_stage


def test_a_stage_that_runs_alone_says_a_problem_once_and_that_it_is_resolved(monkeypatch):
    lines: list[str] = []
    monkeypatch.setattr(one_stage, "_say", lines.append)
    problems = one_stage.Problems("recorder")
    for problem in ("", "12.3 MB are free", "11.9 MB are free", "", ""):
        problems.report(problem)
    assert lines == ["recorder: 12.3 MB are free", "recorder: the problem is resolved"]
