"""The minimisers on problems whose minimum is known, and the wrapper that keeps the best."""

import math
from functools import partial

import pytest
import torch

from bstcad.tailoring import minimise as of_lbfgs
from bstcad.tailoring.minimise import Best, Evaluation, Query, adam, lbfgs, minimise

WEIGHTS = torch.tensor([1.0, 30.0, 1000.0], dtype=torch.float64)
MINIMUM = torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64)


def bowl(parameters):
    off = parameters[0] - MINIMUM
    return float((WEIGHTS * off**2).sum()), [2 * WEIGHTS * off], 0.0


def ended(problem, method, evaluations):
    """Return the last state of a minimisation."""
    *_, last = minimise(problem, method, evaluations)
    return last


def by_lbfgs(problem, start, evaluations):
    return ended(problem, lbfgs([start], evaluations), evaluations)


ORIGIN = torch.zeros(3, dtype=torch.float64)


def test_lbfgs_finds_the_bottom_of_a_bowl():
    best = by_lbfgs(bowl, ORIGIN, 60).best
    torch.testing.assert_close(best.parameters[0], MINIMUM, rtol=0, atol=1e-6)
    assert best.evaluations <= 60


@pytest.mark.parametrize("count", [0, 1, 2, 5])
def test_the_two_loops_apply_the_inverse_hessian_of_bfgs(count):
    """H is updated pair by pair: H' = (I - s yᵀ / sᵀy) H (I - y sᵀ / sᵀy) + s sᵀ / sᵀy (Nocedal and Wright, 6.17)."""
    random = torch.Generator().manual_seed(count)
    s, y = (torch.randn((count, 7), generator=random, dtype=torch.float64) for _ in range(2))
    y = y * torch.sign((s * y).sum(1))[:, None]
    pairs = [(a, b, float((a * b).sum())) for a, b in zip(s, y, strict=True)]
    inverse, unit = torch.eye(7, dtype=torch.float64), torch.eye(7, dtype=torch.float64)
    if pairs:
        inverse = inverse * pairs[-1][2] / float((y[-1] ** 2).sum())
    for a, b, curvature in pairs:
        left = unit - torch.outer(a, b) / curvature
        inverse = left @ inverse @ left.T + torch.outer(a, a) / curvature
    g = torch.randn(7, generator=random, dtype=torch.float64)
    torch.testing.assert_close(of_lbfgs._inverse_hessian_times(g, pairs), inverse @ g, rtol=1e-10, atol=1e-10)


def rosenbrock(parameters):
    """Σ 100 (x_{i+1} - x_i²)² + (1 - x_i)²: a curved valley, its bottom at (1, …, 1)."""
    x = parameters[0].detach().requires_grad_()
    value = (100 * (x[1:] - x[:-1] ** 2) ** 2 + (1 - x[:-1]) ** 2).sum()
    (gradient,) = torch.autograd.grad(value, x)
    return float(value.detach()), [gradient], 0.0


def test_lbfgs_follows_a_curved_valley_as_fast_as_torchs():
    start = torch.linspace(-1.2, 1.5, 20, dtype=torch.float64)
    best, theirs = by_lbfgs(rosenbrock, start, 200).best, []
    x = start.clone()
    optimiser = torch.optim.LBFGS(
        [x], max_iter=200, max_eval=best.evaluations, history_size=12, line_search_fn="strong_wolfe",
        tolerance_grad=0.0, tolerance_change=0.0,
    )  # fmt: skip

    def closure():
        value, [x.grad], _ = rosenbrock([x])
        theirs.append(value)
        return torch.tensor(value)

    optimiser.step(closure)
    torch.testing.assert_close(best.parameters[0], torch.ones_like(start), rtol=0, atol=1e-5)
    assert best.merit <= 10 * min(theirs) + 1e-12


def test_a_run_continues_with_the_pairs_of_the_run_before():
    """A run on a nearly equal problem takes its inverse Hessian from the pairs, and so needs fewer evaluations."""
    weights = torch.logspace(0, 3, 12, dtype=torch.float64)

    def problem(parameters, factor=1.0):
        off = parameters[0] - 1.0
        return float((factor * weights * off**2).sum()), [2 * factor * weights * off], 0.0

    found = list(minimise(problem, lbfgs([torch.zeros(12, dtype=torch.float64)], 30), 30))
    start, finer = found[-1].best.parameters[0], partial(problem, factor=1.1)
    last = next(each.state.pairs for each in reversed(found) if each.state is not None)
    runs = ((), 12), (last, 8)  # pairs and evaluations
    anew, continued = (ended(finer, lbfgs([start], count, pairs=pairs), count).best.merit for pairs, count in runs)
    assert continued < anew / 1.3


def test_lbfgs_steps_back_from_where_the_merit_is_not_finite():
    """-log x + x: nothing below zero, its bottom at 1, and a first step that leads far beyond."""

    def merit(parameters):
        x = parameters[0]
        gradient = torch.where(x > 0, 1 - 1 / x, torch.full_like(x, math.nan))
        return float((x - x.log()).sum()), [gradient], 0.0

    best = by_lbfgs(merit, torch.tensor([9.0, 0.01], dtype=torch.float64), 60).best
    assert best.skipped > 0
    torch.testing.assert_close(best.parameters[0], torch.ones(2, dtype=torch.float64), rtol=0, atol=1e-5)


def test_every_line_search_ends_as_wolfe_asks(monkeypatch):
    """Sufficient decrease and a flatter slope, at each step that lbfgs takes down the valley."""
    search, seen = of_lbfgs._strong_wolfe, []

    def watched(along, start, step):
        found = yield from search(along, start, step)
        seen.append((start, found))
        return found

    monkeypatch.setattr(of_lbfgs, "_strong_wolfe", watched)
    by_lbfgs(rosenbrock, torch.linspace(-1.2, 1.5, 20, dtype=torch.float64), 120)
    assert len(seen) > 50
    for start, found in seen:
        assert found.value <= start.value + of_lbfgs.ARMIJO * found.step * start.slope
        assert abs(found.slope) <= -of_lbfgs.WOLFE * start.slope


def test_lbfgs_says_why_it_ended():
    def flat(parameters):
        return 1.0 + 1e-9 * float(parameters[0].sum()), [torch.full((3,), 1e-9, dtype=torch.float64)], 0.0

    assert by_lbfgs(bowl, ORIGIN, 3).reason == "evaluations"
    assert by_lbfgs(flat, ORIGIN, 200).reason == "plateau"


@pytest.mark.parametrize("gradient", [0.0, math.nan])
def test_a_state_from_which_no_step_leads_down_ends_the_run(gradient):
    """The best evaluation so far stays the result."""
    state = of_lbfgs.LbfgsState(torch.ones(2).double(), 1.0, torch.full((2,), gradient).double())
    best = Best(1.0, parameters=(torch.ones(2),), evaluations=3)
    [end] = minimise(None, lbfgs([torch.ones(2)], 10, state), 10, best)
    assert (end.best, end.parameters, end.reason) == (best, None, "plateau")


def test_adam_finds_the_bottom_of_a_bowl():
    last = ended(bowl, adam([ORIGIN], [0.05], 400), 400)
    torch.testing.assert_close(last.best.parameters[0], MINIMUM, rtol=0, atol=1e-2)
    torch.testing.assert_close(last.parameters[0], MINIMUM, rtol=0, atol=1e-2)


def given(*places):
    """A method that asks for these places, whatever it is evaluation."""
    for place in places:
        yield Query([torch.tensor([place])])
    return "no more"


def test_the_best_state_is_kept_not_the_last():
    values = iter([3.0, 1.0, 2.0])
    last = ended(lambda p: (next(values), [torch.zeros(1)], 0.1), given(10.0, 11.0, 12.0), 3)
    assert last.best.merit == 1.0 and float(last.best.parameters[0]) == 11.0 and last.reason == "no more"


@pytest.mark.parametrize("bad", [(math.nan, 0.0), (1.0, math.inf)])
def test_a_value_that_is_not_finite_is_counted_not_used(bad):
    method, evaluation = given(1.0), []

    def watched():
        evaluation.append((yield next(method)))
        return ""

    last = ended(lambda p: (bad[0], [torch.tensor([bad[1]])], 0.1), watched(), 1)
    assert evaluation[0].merit == math.inf and float(evaluation[0].gradients[0]) == 0.0
    assert last.skipped and last.best.skipped == 1 and last.best.parameters == ()


def test_adam_leaves_out_a_step_that_is_not_finite():
    calls = []

    def problem(parameters):
        calls.append(float(parameters[0]))
        return (math.nan if len(calls) == 1 else calls[-1] ** 2), [2 * parameters[0]], 0.0

    last = ended(problem, adam([torch.tensor([1.0])], [0.1], 3), 3)
    assert calls[0] == calls[1] == 1.0 and calls[2] < 1.0 and last.best.skipped == 1


def test_a_line_search_ends_at_a_jump_of_the_merit():
    """Each trial behind the jump moves the far end nine tenths of the way to it, until both ends are one number."""
    flat = torch.zeros(1, dtype=torch.float64)
    seen = []

    def along(step):
        evaluation = yield Query([torch.tensor([step])])
        seen.append(step)
        return of_lbfgs.LinePoint(step, evaluation.merit, 1e9, flat)

    start, low = of_lbfgs.LinePoint(0.0, 0.0, -1.0, flat), of_lbfgs.LinePoint(1.0, -1.0, -1.0, flat)
    zoom = of_lbfgs._zoom(along, start, low, of_lbfgs.LinePoint(2.0, 1e9, 1e9, flat))
    next(zoom)
    with pytest.raises(StopIteration) as end:
        while True:
            zoom.send(Evaluation(1e9, [flat], Best()))
    assert end.value.value is low
    assert 10 < len(seen) < of_lbfgs.MAX_LINE_TRIALS and min(seen) > 1.0
