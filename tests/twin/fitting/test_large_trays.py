"""Fits of many fans at once: what is saved changes no result but in its last digits.

The same fit is made with matrices of other shapes, which a BLAS multiplies in another order on some processors.
"""

from dataclasses import fields

import numpy as np
import pytest
from scipy.linalg import cholesky

from bench.training.published_fan import rough_run
from twin.fitting import identification, model_uncertainty
from twin.fitting.free_run_problem import FreeRunProblem, sums_by_fan
from twin.fitting.identification import Identification, identify
from twin.runs import Run


@pytest.fixture(scope="module")
def tray() -> Run:
    return rough_run(11, 40.0, 16).run


ROUNDING = 1e-11
"""Relative to the largest of all fans; 1e-14 was measured."""


def assert_same(one: Identification, other: Identification) -> None:
    for field in fields(Identification):
        found, expected = getattr(one, field.name), getattr(other, field.name)
        if isinstance(expected, np.ndarray):
            of_all_fans = np.abs(expected).max(axis=0)
            assert np.all(np.abs(found - expected) <= ROUNDING * of_all_fans), field.name
        else:
            assert found == expected, field.name


def test_fans_that_have_converged_are_left_out_and_all_end_as_if_they_were_not(tray: Run, monkeypatch) -> None:
    fans: set[int] = set()
    normal_equations = FreeRunProblem.normal_equations

    def noted(problem: FreeRunProblem, *arguments):
        fans.add(problem.fans)
        return normal_equations(problem, *arguments)

    monkeypatch.setattr(FreeRunProblem, "normal_equations", noted)
    reported: list[float] = []
    found = identify([tray], progress=lambda _part, _done, _most, rmse: reported.append(rmse))
    assert len(fans) > 1
    assert max(fans) == 16
    fans.clear()
    of_all: list[float] = []
    monkeypatch.setattr(FreeRunProblem, "pays_for_some", lambda *_: False)
    assert_same(identify([tray], progress=lambda _part, _done, _most, rmse: of_all.append(rmse)), found)
    assert fans == {16}
    np.testing.assert_allclose(reported, of_all, ROUNDING)


def test_first_estimates_do_not_depend_on_how_many_are_tried_together(tray: Run, monkeypatch) -> None:
    found = identify([tray])
    monkeypatch.setattr(identification, "COLUMNS_AT_ONCE", 1)
    assert_same(identify([tray]), found)


def test_sums_are_those_of_each_fan() -> None:
    rng = np.random.default_rng(0)
    fan, values = rng.integers(0, 5, 40), rng.normal(size=(40, 3, 2))
    expected = np.zeros((6, 3, 2))
    np.add.at(expected, fan, values)
    np.testing.assert_array_equal(sums_by_fan(values, fan, 6), expected)


def test_what_fans_have_in_common_is_known_from_all_of_them_and_what_is_their_own_from_themselves() -> None:
    rng = np.random.default_rng(1)
    size, own = model_uncertainty.COSINES, model_uncertainty.OWN_VARIANCE
    factors = rng.normal(size=(3, size, size)) * np.geomspace(1e-3, 1e3, size)
    squares = list(factors @ factors.transpose(0, 2, 1))
    roots = list(model_uncertainty._roots(squares))
    one = np.eye(size)
    variance = [np.linalg.inv(each) + own * one for each in squares]
    for fan, root in enumerate(roots):
        others = sum((np.linalg.inv(each) for number, each in enumerate(variance) if number != fan), one / (1.0 - own))
        expected = np.linalg.inv(np.linalg.inv(others) + own * one) + squares[fan]
        np.testing.assert_allclose(root, cholesky(expected, lower=True), rtol=1e-6, atol=1e-6)
