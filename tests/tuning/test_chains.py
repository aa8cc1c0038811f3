"""What the samplers share: starts, burn-in, learning, thinning, files and interruptions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from blackjax.diagnostics import potential_scale_reduction
from jax.scipy.stats import multivariate_normal

import mpfjax
from mpfjax import Checkpoint, Series
from mpfjax.tuning import chains as chains_of
from mpfjax.tuning import metropolis_hastings, particle_gibbs
from mpfjax.tuning.walks import random_walk
from tests.marking import quick_of
from tests.tuning.exact_posteriors import OBSERVATIONS, A, log_prior_of_a, posterior_of_a
from tests.tuning.test_gibbs import assert_moments, draw_a
from tests.tuning.test_sequential import sample_a
from tests.user_models import ScalarLinear

COVARIANCE = np.array([[1.0, 0.9 * 0.05], [0.9 * 0.05, 0.05**2]])
MEAN = np.array([1.0, 2.0])


class Blind(ScalarLinear):
    """Observations say nothing: the posterior is the prior."""

    def log_likelihood(self, observation, states):
        return jnp.zeros(states.shape)


def correlated(parameters):
    point = jnp.stack([parameters["a"], parameters["q"]])
    return multivariate_normal.logpdf(point, jnp.asarray(MEAN), jnp.asarray(COVARIANCE))


def dispersed(key):
    """Starts that are far apart, and often outside of what is possible."""
    a, q = 5 * jax.random.normal(key, (2,))
    return {"a": MEAN[0] + a, "q": MEAN[1] + 0.05 * q}


BLIND = {
    "parameters": {"a": lambda filter: filter.model.a, "q": lambda filter: filter.model.q},
    "log_prior": correlated, "proposal_deviations": {"a": 0.05, "q": 0.3}, "progress": False,
}  # fmt: skip
FILTER = mpfjax.particle_filter(Blind(a=1.0, q=2.0), 2)


def blind(num_steps, *, num_chains=30, key=0, **options):
    arguments = (jax.random.key(key), FILTER, jnp.zeros(1), num_steps)
    return metropolis_hastings(*arguments, num_chains=num_chains, **BLIND | options)


class TestLearning:
    def test_burn_in_finds_the_covariance_and_the_posterior_stays_right(self):
        """Of two numbers of correlation .9, one twenty times as wide as the other, from
        deviations that are the other way round.
        """
        options = {"sample_prior": dispersed, "burn_in": 600}
        run = blind(600, **options)
        points = np.stack([run.parameters["a"], run.parameters["q"]], axis=-1).astype(float)
        ideal = COVARIANCE * 2.38**2 / 2
        np.testing.assert_allclose(run.proposal_covariance, ideal, rtol=0.25)
        assert 0.25 < run.acceptance_rate < 0.45
        assert blind(600, **options | {"burn_in": 0}).acceptance_rate < 0.2
        scale = np.sqrt(np.diag(COVARIANCE))
        standard = (points - MEAN) / scale
        moments = [standard, standard**2 - 1, standard.prod(axis=-1, keepdims=True) - 0.9]
        for found in moments:
            means = found.mean(axis=1)
            error = means.std(axis=0, ddof=1) / np.sqrt(len(means))
            assert (error < 0.05).all()
            assert (np.abs(means.mean(axis=0)) < 4 * error).all()

    def test_it_is_that_of_the_papers(self):
        """The recursion, written for one chain and one number at a time."""
        rng = np.random.default_rng(0)
        points = rng.normal(size=(4, 3, 2))
        reals = {"a": jnp.asarray(points[0, :, 0]), "b": jnp.asarray(points[0, :, 1])}
        walk = random_walk({"a": jnp.asarray(0.3), "b": jnp.asarray(0.7)}, reals)
        mean, log_scale = points[0].mean(axis=0), 0.0
        covariance = np.diag([0.3**2, 0.7**2]) * 2 / 2.38**2
        np.testing.assert_allclose(walk.factor, np.diag([0.3, 0.7]), rtol=1e-6)
        for step in range(3):
            gain = (step + 2) ** -0.6
            spread = np.mean([np.outer(x - mean, x - mean) for x in points[step + 1]], axis=0)
            mean = mean + gain * (points[step + 1].mean(axis=0) - mean)
            covariance = covariance + gain * (spread - covariance)
            log_scale += gain * (0.5 - 0.234)
            new = jnp.asarray(points[step + 1], jnp.float32)
            walk = walk.adapted(new, jnp.asarray(step), jnp.asarray(0.5))
        proposed = walk.factor @ walk.factor.T
        np.testing.assert_allclose(
            proposed, np.exp(2 * log_scale) * 2.38**2 / 2 * covariance, rtol=1e-4
        )


@pytest.mark.thorough
def test_chains_start_at_draws_of_the_prior_so_that_r_hat_sees_where_they_are():
    """Before they meet it is large, and after burn-in it is one."""

    def r_hat(run):
        return max(
            float(potential_scale_reduction(draws).max()) for draws in run.parameters.values()
        )

    options = {"sample_prior": dispersed, "num_chains": 30}
    early = blind(10, **options)
    assert np.ptp(early.parameters["a"][:, 0]) > 5
    assert r_hat(early) > 1.5
    assert r_hat(blind(600, burn_in=600, **options)) < 1.05
    same = blind(1, num_chains=30)
    assert np.ptp(same.parameters["a"]) < 1


def test_thinning_keeps_every_so_many_th_step():
    every, third = blind(31, burn_in=4), blind(31, burn_in=4, thinning=3)
    assert third.parameters["a"].shape == (30, 10)
    np.testing.assert_array_equal(third.parameters["a"], every.parameters["a"][:, 2:30:3])
    np.testing.assert_array_equal(third.accepted, every.accepted[:, 2:30:3])


def gibbs(num_steps, **options):
    filter = mpfjax.particle_filter(ScalarLinear(), 10)
    fixed = {"progress": False, "parameters": A}
    options = {"draw": draw_a, "num_chains": 2} | options
    series = Series.skipping(OBSERVATIONS)
    return particle_gibbs(jax.random.key(0), filter, series, num_steps, **fixed | options)


SAMPLERS = {"metropolis_hastings": blind, "particle_gibbs": gibbs}
WHOLE = {"burn_in": 9, "thinning": 2}


def starts_of(sampler):
    return {"sample_prior": dispersed if sampler is blind else sample_a}


def other_function(sampler):
    """One that does something else under the same name."""
    if sampler is blind:
        return {"log_prior": lambda parameters: correlated(parameters) + parameters["a"]}
    return {"draw": lambda *arguments: {"a": draw_a(*arguments)["a"] + 1.0}}


def interrupt_after(monkeypatch, steps):
    """Ctrl-C once so many steps are made."""
    real = chains_of._steps

    def interrupted(kernel, key, chains, numbers, capacity):
        if int(numbers[0]) >= steps:
            raise KeyboardInterrupt
        return real(kernel, key, chains, numbers, capacity)

    monkeypatch.setattr(chains_of, "_steps", interrupted)


def assert_same_draws(one, other):
    for a, b in zip(jax.tree.leaves(vars(one)), jax.tree.leaves(vars(other)), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("name", quick_of(SAMPLERS, ["metropolis_hastings"]))
class TestResuming:
    def test_interrupted_anywhere_the_draws_are_those_of_one_run(self, name, tmp_path, monkeypatch):
        """In the burn-in, where nothing is lost, and after it, where the draws so far come back."""
        sampler, path = SAMPLERS[name], tmp_path / "chains.npz"
        options = WHOLE | starts_of(sampler)
        whole = sampler(30, **options)
        kept = options | {"checkpoint": Checkpoint(path, every=4)}
        with monkeypatch.context() as patch:
            interrupt_after(patch, 5)
            with pytest.raises(KeyboardInterrupt):
                sampler(30, **kept)
        with monkeypatch.context() as patch:
            interrupt_after(patch, 18)
            with pytest.warns(UserWarning, match=r"interrupted at step \d+ of 39"):
                part = sampler(30, **kept)
        draws = part.parameters["a"].shape[1]
        assert 0 < draws < 15
        assert "interrupted" in part.stopped
        np.testing.assert_array_equal(part.parameters["a"], whole.parameters["a"][:, :draws])
        assert_same_draws(sampler(30, **kept), whole)
        assert_same_draws(sampler(44, **kept), sampler(44, **options))
        shorter = sampler(30, **kept).parameters
        np.testing.assert_array_equal(shorter["a"], whole.parameters["a"])

    def test_a_file_of_other_chains_is_refused(self, name, tmp_path):
        sampler, path = SAMPLERS[name], tmp_path / "chains.npz"
        options = WHOLE | {"checkpoint": Checkpoint(path)}
        sampler(4, **options)
        for other, named in (
            ({"thinning": 1}, "thinning is 2 there and 1 here"),
            ({"num_chains": 3}, "num_chains is .* there and 3 here"),
            ({"checkpoint": Checkpoint(path, name="mine")}, "name is not there"),
            (
                other_function(sampler),
                "draw is" if sampler is gibbs else "log_prior is",
            ),
        ):
            with pytest.raises(ValueError, match=rf"is of another {name}: .*{named}"):
                sampler(4, **options | other)


@pytest.mark.thorough
def test_a_start_without_a_likelihood_is_drawn_again():
    def half(parameters):
        return jnp.where(parameters["a"] > 0, correlated(parameters), -jnp.inf)

    def either(key):
        return dispersed(key) | {"a": jnp.where(jax.random.bernoulli(key), 1.0, -1.0)}

    first = next(k for k in range(99) if _first_draw(either, k) > 0)
    run = blind(1, sample_prior=either, log_prior=half, key=first)
    assert (run.parameters["a"] > 0).all()
    with pytest.raises(ValueError, match="log_prior: -inf at a draw of sample_prior"):
        blind(1, sample_prior=lambda key: {"a": -1.0, "q": 2.0}, log_prior=half)


def _first_draw(sample_prior, seed):
    key_start, _ = jax.random.split(jax.random.key(seed))
    return sample_prior(jax.random.split(key_start, 1)[0])["a"]


@pytest.mark.thorough
def test_metropolis_steps_that_learn_their_scale_sample_the_exact_posterior():
    """Of particle Gibbs, from deviations that are a hundred times too small."""

    class Known(ScalarLinear):
        def log_initial(self, states):
            return jax.scipy.stats.norm.logpdf(states, self.m, self.p)

    run = particle_gibbs(
        jax.random.key(1), mpfjax.particle_filter(Known(), 10), Series.skipping(OBSERVATIONS), 320,
        log_prior=log_prior_of_a, sample_prior=sample_a, parameters=A, num_chains=60,
        proposal_deviations=0.005, burn_in=200, progress=False,
        collect=lambda trajectory: None,
    )  # fmt: skip
    assert run.trajectories is None
    assert 0.3 < run.acceptance_rate < 0.6
    assert_moments(run.parameters["a"], posterior_of_a())


@pytest.mark.usefixtures("as_installed")
@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"burn_in": -1}, "burn_in: -1"),
        ({"thinning": 0}, "thinning: 0"),
        ({"thinning": 9}, "thinning: 9 is more than num_steps, 4"),
        ({"sample_prior": 3}, "sample_prior: 3"),
        ({"sample_prior": lambda key: {"b": 1.0}}, r"sample_prior: it gave \['b'\]"),
        ({"checkpoint": 3}, "checkpoint: 3"),
    ],
)
@pytest.mark.parametrize("name", SAMPLERS)
def test_bad_arguments_are_refused_by_name(name, options, named):
    with pytest.raises(ValueError, match=named):
        SAMPLERS[name](4, **options)
