"""Learned look-aheads: exact whatever they are, and far less noisy than the filter they are of."""

from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax.exact import grid_filter, kalman_filter, switching_filter
from mpfjax.smoothing import learn_lookahead
from tests.marking import thorough
from tests.moves import test_marginalised_mixed as mixed
from tests.switching import MODEL as REGIMES
from tests.switching import OBSERVATIONS as SEEN

NUM_RUNS = 400
GRID = jnp.linspace(-4.0, 4.0, 1601)
SQUARE = mpfjax.QuadraticModel(0.2, 0.2, -2.5, 2.5, initial_draw="independent")
LINE = mpfjax.LinearGaussianModel(
    A=[[1.0, 0.5], [0.0, 0.9]], Q=[[0.1, 0.02], [0.02, 0.1]], H=[[1.0, 0.0]], R=[[0.1]],
    m0=[0.0, 0.3], P0=[[1.0, 0.2], [0.2, 0.5]],
)  # fmt: skip
PATH = 1.3 + 0.2 * jnp.sin(jnp.arange(1.0, 9.0))
NOISE = 0.2 * jax.random.normal(jax.random.key(7), (8,))
NO_FILTER: Any = None
NO_FEATURES: Any = 3
KEYS = jax.random.split(jax.random.key(2), NUM_RUNS)


def side(states):
    return (states > 0).astype(jnp.int32)


def in_groups(model):
    groups = [mpfjax.GroupBy(side)]
    moves = [mpfjax.Resample(), mpfjax.Propagate(model), *groups]
    return mpfjax.Filter(model, moves, 60, 2, initial_moves=groups)


CASES = {
    "two modes": (SQUARE, in_groups, PATH**2 + NOISE),
    "linear": (LINE, lambda model: mpfjax.particle_filter(model, 60), (PATH + NOISE)[:, None]),
    "linear, one missing": (
        LINE,
        lambda model: mpfjax.particle_filter(model, 60),
        (PATH + NOISE)[:, None].at[3].set(jnp.nan),
    ),
    "two modes, adaptive, rqmc": (
        SQUARE,
        lambda model: mpfjax.mixture_particle_filter(model, 60, 2, ess_threshold=0.5, noise="rqmc"),
        PATH**2 + NOISE,
    ),
}


@cache
def learned(case):
    model, make, observations = CASES[case]
    return learn_lookahead(jax.random.key(0), make(model), mpfjax.Series.skipping(observations), 3)


def moments(mixture):
    states = mixture.particles.reshape(mixture.num_particles, -1)
    return mixture.average(states), mixture.average(states**2)


def runs(case, filter):
    return mpfjax.monte_carlo(KEYS, filter, CASES[case][2], moments, missing="skip")


def truth(case):
    """log Z, and E[x_s] and E[x_s²] at each step s."""
    model, _, observations = CASES[case]
    if model is LINE:
        exact = kalman_filter(model, mpfjax.Series.skipping(observations))
        second = jnp.diagonal(exact.covariances, axis1=1, axis2=2) + exact.means**2
        return exact.log_likelihood_increments, exact.means, second
    exact = grid_filter(model, observations, GRID)
    first, second = exact.means[:, None], (exact.variances + exact.means**2)[:, None]
    return exact.log_likelihood_increments, first, second


@pytest.mark.parametrize(
    "case",
    thorough(CASES),
)
def test_the_evidence_and_moments_are_unbiased_at_every_step(case):
    """E[Ẑ/Z] = 1 and E[Ẑ/Z φ̂] = E[φ | y], within four standard errors; and the noise is less."""
    run = runs(case, learned(case))
    increments, first, second = map(np.asarray, truth(case))
    logs = np.cumsum(np.asarray(run.log_likelihood_increments), axis=1) - np.cumsum(increments)
    ratios = np.exp(logs)
    for values, exact in zip(run.collected, (first, second), strict=True):
        weighed = np.asarray(values) * ratios[:, :, None]
        error = weighed.std(axis=0) / np.sqrt(NUM_RUNS)
        assert (np.abs(weighed.mean(axis=0) - exact) <= 4 * error + 2e-3).all()
    error = ratios.std(axis=0) / np.sqrt(NUM_RUNS)
    assert (np.abs(ratios.mean(axis=0) - 1) <= 4 * error + 1e-3).all()
    if "rqmc" in case:  # which leaves little to gain in one dimension
        return
    plain = runs(case, CASES[case][1](CASES[case][0]))
    spread = float(np.asarray(plain.log_marginal_likelihood).std())
    assert logs[:, -1].std() < 0.5 * spread


@pytest.mark.thorough
def test_a_linear_model_has_hardly_any_noise_left():
    run = runs("linear", learned("linear"))
    assert float(run.log_marginal_likelihood.std()) < 0.1


def test_a_look_ahead_that_is_wrong_is_exact_all_the_same():
    """ψ of other observations: the weights undo it, however bad it is."""
    observations = CASES["two modes"][2][:4]
    other = 0.8 * observations
    keys = jax.random.split(jax.random.key(4), 2000)
    filter = learned("two modes")
    run = mpfjax.monte_carlo(keys, filter, other, lambda mixture: None)
    exact = grid_filter(SQUARE, other, GRID).log_marginal_likelihood
    ratios = np.exp(np.asarray(run.log_marginal_likelihood) - float(exact))
    assert abs(ratios.mean() - 1) <= 4 * ratios.std() / np.sqrt(2000)


@pytest.mark.thorough
def test_steps_one_by_one_equal_the_run():
    filter, observations = learned("two modes"), CASES["two modes"][2]
    key = jax.random.key(3)
    run = mpfjax.run_filter(key, filter, observations)
    key_initial, key_steps = jax.random.split(key)
    mixture, total = filter.init(key_initial), 0.0
    keys = jax.random.split(key_steps, len(observations))
    for step_key, seen in zip(keys, observations, strict=True):
        mixture, info = filter.step(step_key, mixture, seen)
        total += float(info.log_likelihood_increment)
    assert total == pytest.approx(float(run.log_marginal_likelihood), abs=1e-3)
    assert float(run.initial.weights.sum()) == pytest.approx(1.0, abs=1e-5)


@pytest.mark.thorough
def test_samplers_take_it():
    filter = learned("two modes")
    density = mpfjax.tuning.log_density(
        filter, CASES["two modes"][2], log_prior=lambda of: -(of["model.sigma_x"] ** 2),
        parameters={"model.sigma_x": lambda f: f.model.sigma_x},
        transforms={"model.sigma_x": mpfjax.tuning.Positive()},
    )  # fmt: skip
    assert np.isfinite(float(density(density.start, jax.random.key(0))))


GAP = mixed.OBSERVATIONS.at[2].set(jnp.nan)
MARGINALISED = {
    "mixed form": (mixed.Mixed(), mixed.OBSERVATIONS, 0.5),
    "mixed form, one missing": (mixed.Mixed(), GAP, 0.6),
    "regimes": (REGIMES, SEEN, 1.0),
}


@pytest.mark.parametrize("case", ["mixed form", *thorough(["mixed form, one missing", "regimes"])])
def test_a_conditionally_linear_model_learns_too(case):
    """E[Ẑ/Z] = 1 and E[Ẑ/Z E[x]] = E[x | y], and the noise of log Ẑ falls to a share of it."""
    model, observations, share = MARGINALISED[case]
    plain = mpfjax.particle_filter(model, 60)
    ahead = learn_lookahead(jax.random.key(0), plain, mpfjax.Series.skipping(observations), 3)
    if model is REGIMES:
        exact = switching_filter(model, observations)
    else:
        exact = kalman_filter(mixed.whole(True), mpfjax.Series.skipping(observations))

    def logs(filter):
        collect = lambda mixture: mixture.mean().mean  # noqa: E731
        run = mpfjax.monte_carlo(KEYS, filter, observations, collect, missing="skip")
        gaps = run.log_likelihood_increments - exact.log_likelihood_increments[None]
        return np.cumsum(np.asarray(gaps), axis=1), np.asarray(run.collected)

    found, means = logs(ahead)
    ratios = np.exp(found)
    for values, truth in (
        (ratios, np.ones(len(observations))),
        (ratios[..., None] * means, np.asarray(exact.means)[:, -2:]),
    ):
        error = values.std(axis=0) / np.sqrt(NUM_RUNS)
        assert (np.abs(values.mean(axis=0) - truth) <= 4 * error + 1e-3).all()
    assert found[:, -1].std() < share * logs(plain)[0][:, -1].std()


@pytest.mark.usefixtures("as_installed")
@pytest.mark.parametrize(
    ("make", "named"),
    [
        (lambda: learn_lookahead(jax.random.key(0), NO_FILTER, PATH), "filter: None"),
        (lambda: learn_lookahead(jax.random.key(0), in_groups(SQUARE), PATH, 0), "num_passes: 0"),
        (
            lambda: learn_lookahead(
                jax.random.key(0), in_groups(SQUARE), PATH, features=NO_FEATURES
            ),
            "features: 3",
        ),
        (
            lambda: learn_lookahead(
                jax.random.key(0), mpfjax.gaussian_particle_filter(SQUARE, 20), PATH
            ),
            "filter: .* cannot look ahead",
        ),
        (
            lambda: learn_lookahead(
                jax.random.key(0), mpfjax.Filter(SQUARE, [mpfjax.Propagate(SQUARE)], 20), PATH
            ),
            "filter: its moves need one Resample",
        ),
        (
            lambda: learn_lookahead(
                jax.random.key(0),
                mpfjax.Filter(REGIMES, [mpfjax.PropagateRegimes(REGIMES)], 20),
                PATH[:, None],
            ),
            "filter: PropagateRegimes, one of its moves, cannot look ahead",
        ),
    ],
)
def test_bad_input_is_named(make, named):
    with pytest.raises(ValueError, match=named):
        make()
