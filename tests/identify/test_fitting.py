"""Fits with known solutions, and the coverage of their intervals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.errors import SurefootError

pytest.importorskip("mujoco")

from surefoot.identify.fitting import fit_least_squares, forward_jacobian, hold_unidentifiable
from surefoot.identify.model import Unknown
from surefoot.identify.result import NORMAL_95


def unknown(name: str = "a", start: float = 0.0, **more: float | int | None) -> Unknown:
    return replace(Unknown(name, start, -1000.0, 1000.0, 1e-3), **more)


class Linear:
    """Model with residuals A x - y, which counts the evaluated candidates."""

    def __init__(self, matrix: Array, data: Array, unknowns: list[Unknown], blocks: Array | None = None) -> None:
        self.matrix, self.data, self.unknowns = np.asarray(matrix, float), np.asarray(data, float), unknowns
        self.blocks = np.arange(len(data)) if blocks is None else np.asarray(blocks, np.int64)
        self.candidates = 0

    def residuals(self, values: Array) -> Array:
        self.candidates += len(values)
        return values @ self.matrix.T - self.data

    def affected(self, k: int) -> NDArray[np.bool_] | None:
        return self.matrix[:, k] != 0

    def restrict(self, free: NDArray[np.bool_], values: Array) -> Linear:
        data = self.data - self.matrix[:, ~free] @ values[~free]
        unknowns = [one for one, is_free in zip(self.unknowns, free, strict=True) if is_free]
        return Linear(self.matrix[:, free], data, unknowns, self.blocks)


class Decay:
    """Model of values a exp(-b t), measured with unit noise."""

    time = np.linspace(0.0, 3.0, 60)

    def __init__(self, data: Array) -> None:
        self.data, self.blocks = data, np.arange(60)
        self.unknowns = [Unknown("a", 20.0, 1.0, 100.0, 1e-5), Unknown("b", 0.5, 0.01, 10.0, 1e-6)]

    def residuals(self, values: Array) -> Array:
        return values[:, :1] * np.exp(-values[:, 1:] * self.time) - self.data

    def affected(self, k: int) -> None:
        return None


def line(scatter: float) -> Linear:
    """Return a model a + b x of three points; the residuals are -1/2, 1, -1/2 times `scatter`."""
    x = np.array([-1.0, 0.0, 1.0])
    data = 3.0 + 2.5 * x + scatter * np.array([0.5, -1.0, 0.5])
    return Linear(np.stack([np.ones(3), x], axis=1), data, [unknown("a"), unknown("b")])


def test_a_line_through_three_points():
    fit = fit_least_squares(line(1.0))
    np.testing.assert_allclose(fit.values, [3.0, 2.5], atol=1e-7)
    np.testing.assert_allclose(fit.residuals, [-0.5, 1.0, -0.5], atol=1e-6)
    # Residuals are smaller than their noise, so the covariance is H^-1 with H = diag(3, 2).
    np.testing.assert_allclose(fit.covariance, np.diag([1 / 3, 1 / 2]), atol=1e-5)
    np.testing.assert_allclose(fit.deviation, [3**-0.5, 2**-0.5], rtol=1e-4)
    assert (fit.identifiable.all(), fit.strongest_correlations()) == (True, [])


def test_residuals_larger_than_their_noise_widen_intervals():
    # Gradients are J_i r_i, with sums of squares 16 (1/4 + 1 + 1/4) and 16 (1/4 + 1/4); 3 blocks, 2 degrees of freedom;
    # H = diag(3, 2).
    fit = fit_least_squares(line(4.0))
    np.testing.assert_allclose(np.diag(fit.covariance), [24 * 1.5 / 9, 8 * 1.5 / 4], rtol=1e-4)


def test_a_prior_counts_as_a_residual():
    # Four measurements of 2 and a prior of 0 +- 1/2, which has the weight of four measurements: the mean is 1.
    model = Linear(np.ones((4, 1)), np.full(4, 2.0), [unknown(prior=0.5)])
    fit = fit_least_squares(model)
    assert fit.values[0] == pytest.approx(1.0)
    assert len(fit.residuals) == 4
    # H = 4 + 4; four gradients of -1 in 4 blocks with 3 degrees of freedom, and 4 from the prior.
    assert fit.covariance[0, 0] == pytest.approx((4 * 4 / 3 + 4) / 64, rel=1e-4)


def test_values_stay_within_bounds():
    model = Linear(np.ones((4, 1)), np.full(4, 2.0), [unknown(high=1.5)])
    assert fit_least_squares(model).values[0] == pytest.approx(1.5, abs=1e-9)
    # A start outside the bounds is moved to the bounds.
    costs: list[float] = []
    fit_least_squares(model, np.array([7.0]), lambda step, cost: costs.append(cost))
    assert costs[0] == pytest.approx(0.25)


def test_candidates_stay_within_bounds():
    class Strict(Linear):
        def residuals(self, values: Array) -> Array:
            low, high = (np.array([getattr(u, side) for u in self.unknowns]) for side in ("low", "high"))
            assert np.all((low <= values) & (values <= high)), values
            return super().residuals(values)

    # Steps that are not powers of two: scaled values are rounded on their way to the solver and back.
    rng = np.random.default_rng(4)
    for _ in range(30):
        bounds = [(-float(a), float(b)) for a, b in rng.uniform(0.1, 0.9, (3, 2))]
        unknowns = [unknown(str(k), low=a, high=b, step=1e-6 / 3) for k, (a, b) in enumerate(bounds)]
        fit = fit_least_squares(Strict(rng.normal(size=(9, 3)), 10 * rng.normal(size=9), unknowns))
        assert np.all((fit.values >= [a for a, _ in bounds]) & (fit.values <= [b for _, b in bounds]))


def test_unknowns_of_one_colour_share_a_candidate():
    rng = np.random.default_rng(2)
    matrix = np.zeros((12, 4))
    matrix[:6, :2], matrix[6:, 2:] = rng.normal(size=(2, 6, 2))
    plain = [unknown(name) for name in "abcd"]
    coloured = [replace(u, colour=k % 2) for k, u in enumerate(plain)]
    at = np.array([1.0, 2.0, 3.0, 1000.0])
    jacobians, counts = [], []
    for unknowns in (plain, coloured):
        model = Linear(matrix, np.zeros(12), unknowns)
        jacobians.append(forward_jacobian(model, at, matrix @ at))
        counts.append(model.candidates)
    assert counts == [4, 2]
    np.testing.assert_allclose(jacobians[0], matrix, atol=1e-6)
    np.testing.assert_allclose(jacobians[0], jacobians[1], atol=1e-8)


def test_a_derivative_at_a_bound_steps_inward():
    evaluated: list[float] = []

    class Logged(Linear):
        def residuals(self, values: Array) -> Array:
            evaluated.extend(values[:, 0])
            return super().residuals(values)

    model = Logged([[2.0]], np.zeros(1), [unknown(high=5.0)])
    np.testing.assert_allclose(forward_jacobian(model, np.array([5.0]), np.array([10.0])), [[2.0]])
    assert evaluated == [4.999]


def test_residuals_of_one_block_count_as_one_measurement():
    # 20 blocks of 10 equal residuals, +1 or -1, determine the mean like 20 measurements, not 200.
    offsets = np.repeat(np.tile([1.0, -1.0], 10), 10)
    blocks = np.repeat(np.arange(20), 10)
    together = fit_least_squares(Linear(np.ones((200, 1)), offsets, [unknown()], blocks))
    apart = fit_least_squares(Linear(np.ones((200, 1)), offsets, [unknown()]))
    assert together.covariance[0, 0] == pytest.approx(1 / 20 * 20 / 19, rel=1e-4)
    assert apart.covariance[0, 0] == pytest.approx(1 / 200 * 200 / 199, rel=1e-4)


def test_an_unknown_without_effect_is_not_identifiable():
    model = Linear([[1.0, 0.0]] * 9, np.full(9, 2.0), [unknown("a"), unknown("b", 0.3, low=0.0, high=1.0)])
    fit = fit_least_squares(model)
    assert fit.values[0] == pytest.approx(2.0)
    assert fit.values[1] == pytest.approx(0.3)
    assert fit.identifiable.tolist() == [True, False]
    assert fit.deviation[0] == pytest.approx(1 / 3, rel=1e-4)
    assert fit.deviation[1] == pytest.approx(1.0, rel=1e-3)


def test_terms_of_a_sum_are_not_identifiable_but_their_sum_is():
    matrix = np.array([[1.0, 1.0, 0.0]] * 10 + [[0.0, 0.0, 1.0]] * 10)
    bounded = [unknown(name, low=-10.0, high=10.0, index=3 if name == "b" else None) for name in "abc"]
    data = np.full(20, 2.0) + np.tile([1.0, -1.0], 10)
    fit = fit_least_squares(Linear(matrix, data, bounded))
    assert fit.values[0] + fit.values[1] == pytest.approx(2.0, abs=1e-4)
    assert fit.identifiable.tolist() == [False, False, True]
    assert fit.correlation[0, 1] == pytest.approx(-1.0, abs=1e-2)
    ((first, second, strength),) = fit.strongest_correlations()
    assert (first, second) == ("a", "b[3]")
    assert strength < -0.99
    # Their sum is known like a single unknown, from ten values: half of the 20 blocks depend on it.
    total = np.array([1.0, 1.0, 0.0])
    assert np.sqrt(total @ fit.covariance @ total) == pytest.approx(0.1**0.5, rel=0.05)


def test_intervals_contain_the_true_values_in_95_percent():
    rng, truth = np.random.default_rng(7), np.array([30.0, 0.8])
    clean = truth[0] * np.exp(-truth[1] * Decay.time)
    inside = []
    for _ in range(200):
        fit = fit_least_squares(Decay(clean + rng.normal(size=60)))
        inside.append(np.abs(fit.values - truth) <= NORMAL_95 * fit.deviation)
    coverage = np.mean(inside)
    assert 0.92 <= coverage <= 0.985, coverage


def test_a_converged_fit_ends():
    # With finite differences of a rounded model no further step helps; the fit must end instead of trying more.
    rng = np.random.default_rng(3)

    class Rounded(Decay):
        evaluations = 0

        def residuals(self, values: Array) -> Array:
            self.evaluations += len(values)
            return np.round(super().residuals(values), 7)

    progress: list[tuple[int, float]] = []
    model = Rounded(30.0 * np.exp(-0.8 * Decay.time) + rng.normal(size=60))
    fit = fit_least_squares(model, report=lambda k, cost: progress.append((k, cost)))
    assert model.evaluations < 40
    assert [k for k, _ in progress] == list(range(1, len(progress) + 1))
    costs = [cost for _, cost in progress]
    assert costs == sorted(costs, reverse=True)
    assert np.mean(fit.residuals**2) <= costs[-1] * (1 + 1e-9)


def test_fit_rejects_residuals_that_are_not_finite():
    model = Linear(np.ones((4, 1)), np.full(4, np.nan), [unknown()])
    with pytest.raises(SurefootError, match="diverges with the initial parameters"):
        fit_least_squares(model)


def test_undetermined_unknowns_are_held_and_widen_the_others():
    draw = np.random.default_rng(1)
    # Only a + b affects the residuals; the priors are 100 for a and 1 for b.
    unknowns = [unknown("a", 0.0, prior=100.0), unknown("b", 2.0, prior=1.0)]
    data = 7.0 + draw.normal(0, 1, 400)
    model = Linear(np.ones((400, 2)), data, unknowns)
    fit = fit_least_squares(model)
    assert fit.identifiable.tolist() == [True, False]
    held = hold_unidentifiable(model, fit)
    assert held.held is not None
    assert held.held.tolist() == [False, True]
    assert held.values == pytest.approx([data.mean() - 2.0, 2.0], abs=0.01)
    # The error of a is the negative error of b; their sum is known.
    assert held.deviation == pytest.approx([1.0, 1.0], rel=0.02)
    assert np.sqrt(np.ones(2) @ held.covariance @ np.ones(2)) == pytest.approx(0.05, rel=0.2)


def test_considered_unknowns_widen_intervals_and_are_never_fitted():
    draw = np.random.default_rng(2)
    x = np.linspace(-1.0, 1.0, 400)
    matrix = np.stack([np.ones(400), 0.5 + 0.2 * x], axis=1)
    considered = unknown("c", 0.0, prior=0.3)
    data = 3.0 + draw.normal(0, 1, 400)
    model = Linear(matrix, data, [unknown("a", 0.0, prior=100.0), considered])
    restricted = model.restrict(np.array([True, False]), np.zeros(2))
    held = hold_unidentifiable(model, fit_least_squares(restricted), [considered])
    assert (held.considered, held.held.tolist()) == (1, [False, True])
    assert held.values == pytest.approx([data.mean(), 0.0], abs=1e-3)
    # Residuals hardly show c, so half of its prior uncertainty, 0.5 x 0.3, adds to 1 / sqrt(400).
    assert held.deviation[0] == pytest.approx(np.hypot(0.05, 0.15), rel=0.25)
    # If larger errors of c would show in the residuals, it adds less.
    sharp = Linear(100 * matrix, 300.0 + draw.normal(0, 1, 400), model.unknowns)
    restricted = sharp.restrict(np.array([True, False]), np.zeros(2))
    exact = hold_unidentifiable(sharp, fit_least_squares(restricted), [considered])
    assert exact.deviation[0] < 0.01


def test_an_unknown_with_equal_bounds_is_rejected():
    pinned = unknown("servo_latency", 0.003, low=0.003, high=0.003)
    with pytest.raises(
        SurefootError, match=r"servo_latency can't be fitted between 0.003 and 0.003; widen \[allowed\]"
    ):
        fit_least_squares(Linear(np.ones((3, 1)), np.ones(3), [pinned]))
