"""The first steps of a filter by a tempered sampler: exact, one at a time or not."""

from functools import partial

import chex
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax.exact import kalman_filter
from mpfjax.moves.start.start import Start
from mpfjax.smoothing import conditional_filter, sample_trajectories
from tests.moves.start.test_window import PLANE, WithKeys
from tests.together.test_inputs import INPUTS, OBSERVATIONS, Driven, truth
from tests.unbiased import assert_unbiased, ratios_to
from tests.user_models import Batched

KEY = jax.random.key(0)
STEPS, LENGTH = 9, 3


def observations():
    rng = np.random.default_rng(0)
    places = np.array([3.0, 1.0]) + np.cumsum(0.1 * rng.normal(size=(STEPS, 2)), axis=0)
    return (places + 0.3 * rng.normal(size=(STEPS, 2))).astype(np.float32)


SEEN = observations()
GAPS = np.where(np.isin(np.arange(STEPS), [0, 5])[:, None], np.nan, SEEN)
PLAIN = mpfjax.mixture_particle_filter(WithKeys(), 100, 3)
FILTER = mpfjax.with_start(PLAIN, LENGTH)


def mean(mixture):
    return mixture.mean()


@pytest.mark.exactness
def test_evidence_and_moments_are_unbiased_beyond_the_window():
    """Two observations are missing, the first among them."""
    series = mpfjax.Series.skipping(GAPS)
    runs = mpfjax.monte_carlo(jax.random.split(KEY, 300), FILTER, series, mean)
    exact = kalman_filter(PLANE, series)
    ratios = ratios_to(exact, runs)
    assert_unbiased(ratios, loosest=0.05)
    assert_unbiased(ratios[:, None] * np.asarray(runs.collected)[:, -1], exact.means[-1])


@pytest.mark.exactness
def test_one_step_at_a_time_is_a_run():
    run = mpfjax.run_filter(KEY, FILTER, SEEN, mean)
    key_start, key_steps = jax.random.split(KEY)
    mixture = FILTER.init(key_start, SEEN[0])
    for t, key in enumerate(jax.random.split(key_steps, STEPS)):
        mixture, info = FILTER.step(key, mixture, SEEN[t])
        np.testing.assert_allclose(info.log_likelihood_increment, run.log_likelihood_increments[t])
        np.testing.assert_allclose(mixture.mean(), run.collected[t], rtol=1e-5)
        assert (np.asarray(mixture.ancestor_indices) == -1).all() == (t < LENGTH)


@pytest.mark.weekly
def test_fewer_observations_than_the_window_has():
    run = mpfjax.run_filter(KEY, FILTER, SEEN, mean)
    short = mpfjax.run_filter(KEY, FILTER, SEEN[: LENGTH - 1], mean)
    assert np.isfinite(short.log_marginal_likelihood)
    same = run.log_likelihood_increments[: LENGTH - 1].sum()
    assert abs(short.log_marginal_likelihood - same) < 3


def test_a_checkpoint_within_the_window_goes_on_to_the_bit(tmp_path):
    mixture, _ = FILTER.step(KEY, FILTER.init(KEY, SEEN[0]), SEEN[0])
    mpfjax.save_checkpoint(tmp_path / "first.npz", mixture)
    loaded = mpfjax.load_checkpoint(tmp_path / "first.npz", like=mixture)
    both = [FILTER.step(KEY, each, SEEN[1])[0] for each in (mixture, loaded)]
    chex.assert_trees_all_equal(*both)


@pytest.mark.weekly
def test_runs_at_different_steps_are_as_alone():
    """One is within the window, and one beyond it."""
    mixtures = [FILTER.init(KEY, SEEN[0])]
    for y in SEEN[: LENGTH + 1]:
        mixtures.append(FILTER.step(KEY, mixtures[-1], y)[0])
    pair = [mixtures[1], mixtures[-1]]
    together = jax.vmap(lambda mixture: FILTER.step(KEY, mixture, SEEN[1])[0])(
        jax.tree.map(lambda *leaves: jnp.stack(leaves), *pair)
    )
    for run, mixture in enumerate(pair):
        alone, _ = FILTER.step(KEY, mixture, SEEN[1])
        of_run = jax.tree.map(lambda leaf, run=run: leaf[run], together)
        np.testing.assert_allclose(of_run.mean(), alone.mean(), rtol=1e-4)


@pytest.mark.weekly
def test_inputs_of_each_step_are_those_of_the_window():
    log_z, filtered, _ = truth()
    filter = mpfjax.with_start(mpfjax.particle_filter(Driven(), 100), LENGTH)
    series = mpfjax.Series(OBSERVATIONS, INPUTS)
    runs = mpfjax.monte_carlo(jax.random.split(KEY, 300), filter, series, mean)
    ratios = ratios_to(log_z, runs)
    assert_unbiased(ratios, loosest=0.03)
    assert_unbiased(ratios[:, None] * np.asarray(runs.collected), filtered, loosest=0.05)


@pytest.mark.exactness
def test_trajectories_are_drawn_backwards_and_ancestors_refused():
    filter = mpfjax.with_start(mpfjax.particle_filter(Driven(), 200), LENGTH)
    series = mpfjax.Series(OBSERVATIONS, INPUTS)

    @jax.jit
    @jax.vmap
    def smooth(key):
        run = mpfjax.run_filter(key, filter, series)
        return sample_trajectories(key, Driven(), run, 100, inputs=INPUTS).mean(axis=0)

    assert_unbiased(smooth(jax.random.split(KEY, 40)), truth()[2], loosest=0.05, slack=0.02)
    with pytest.raises(ValueError, match="one parent"):
        mpfjax.with_eve_indices(filter)
    with pytest.raises(ValueError, match="cannot keep a trajectory"):
        conditional_filter(KEY, filter, series, jnp.zeros(len(OBSERVATIONS) + 1))


@pytest.mark.exactness
def test_the_gradient_is_the_score():
    """Of the increments of all first steps together, by Fisher's identity."""
    first = SEEN[:LENGTH]

    def log_z(scale):
        return kalman_filter(at(scale), first).log_marginal_likelihood

    def at(scale):
        return eqx.tree_at(lambda m: m.P0, PLANE, scale * PLANE.P0)

    @jax.jit
    @jax.grad
    def score(scale, key):
        filter = mpfjax.with_start(mpfjax.particle_filter(at(scale), 150), LENGTH)
        return mpfjax.run_filter(key, filter, first, mean).log_marginal_likelihood

    scores = [score(1.0, key) for key in jax.random.split(KEY, 20)]
    assert_unbiased(scores, float(jax.grad(log_z)(1.0)), loosest=0.25)


@pytest.mark.weekly
def test_islands_have_the_masses_of_their_own_starts():
    def run(key):
        return mpfjax.run_islands(key, FILTER.replace(num_particles=50), SEEN, mean, num_islands=2)

    runs = jax.jit(jax.vmap(run))(jax.random.split(KEY, 300))
    assert_unbiased(ratios_to(kalman_filter(PLANE, SEEN), runs))


def test_a_start_and_restarts_are_one_whichever_comes_first():
    restarts = partial(mpfjax.with_restarts, probability=0.1, num_observations=LENGTH)
    both = restarts(FILTER), mpfjax.with_start(restarts(PLAIN), LENGTH)
    assert eqx.tree_equal(*both)
    assert sum(isinstance(move, Start) for move in both[0].moves) == 1


@pytest.mark.exactness
def test_without_y_1_x_0_are_plain_draws():
    mixture, _ = FILTER.step(KEY, FILTER.init(KEY), SEEN[0])
    assert (np.asarray(mixture.ancestor_indices) >= 0).all()


@pytest.mark.exactness
def test_what_cannot_begin_so_is_refused():
    with pytest.raises(ValueError, match="needs every slot"):
        mpfjax.monte_carlo(jax.random.split(KEY, 2), FILTER, SEEN, mean, slots=120)
    with pytest.raises(ValueError, match="first observations already"):
        mpfjax.with_start(FILTER)
    with pytest.raises(ValueError, match="more observations than y_1"):
        mpfjax.with_selected_start(FILTER)
    with pytest.raises(ValueError, match="defines no log_initial"):
        mpfjax.with_start(mpfjax.particle_filter(Batched(), 50))
