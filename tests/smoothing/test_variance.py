"""Errors of log Ẑ and of masses from one run, against many runs and the exact pairs of one."""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax import Every, Filter, KMeans, Propagate, Resample
from mpfjax.exact import kalman_filter
from mpfjax.smoothing import with_first_ancestors
from mpfjax.smoothing.variance import log_marginal_likelihood_variance, mixture_weight_errors
from tests.marking import thorough
from tests.registry import RandomLabels

ONE = mpfjax.LinearGaussianModel(A=[[0.9]], Q=[[0.3]], H=[[1.0]], R=[[0.4]], m0=[0.5], P0=[[1.0]])
OBJECTS = mpfjax.MultiObjectModel(ONE, 2)
SQUARE = mpfjax.QuadraticModel(0.3, 0.4, -2.0, 2.0, initial_draw="independent")
SEEN = np.array([[0.8], [0.3], [0.1], [-0.4], [0.9]], np.float32)


def nothing(mixture):
    return None


DRAWS = {"scheme": "multinomial"}


RANDOM_LABELS = RandomLabels()


def labelled(model, n, ess_threshold=1.0, regrouping=RANDOM_LABELS, m=3):
    """Components, of random members if nothing else, which are resampled apart."""
    moves = [Resample("multinomial", ess_threshold), Propagate(model), regrouping]
    return Filter(model, moves, n, m, initial_moves=[KMeans(3, reseed=True)])


SMALL = {
    "pf": (mpfjax.particle_filter(ONE, 30, **DRAWS), SEEN),
    "kmeans, adaptive": (labelled(ONE, 30, 0.5, KMeans()), SEEN),
    "dps": (
        mpfjax.distributed_partitioned_sampling(OBJECTS, 30, reassembly="evidence", **DRAWS),
        np.stack([SEEN, -SEEN], axis=1),
    ),
}


def many(filter, observations, num_runs):
    """Many runs, log Ẑ and its variance from each."""
    keys = jax.random.split(jax.random.key(0), num_runs)
    filter = with_first_ancestors(filter)
    runs = mpfjax.monte_carlo(keys, filter, observations, nothing)
    variances = jax.vmap(log_marginal_likelihood_variance)(runs)
    return runs, np.asarray(runs.log_marginal_likelihood, float), np.asarray(variances, float)


@cache
def exact_evidence(num_objects):
    runs = [kalman_filter(ONE, jnp.asarray(sign * SEEN)) for sign in (1, -1)[:num_objects]]
    return sum(float(run.log_marginal_likelihood) for run in runs)


@pytest.mark.parametrize("name", thorough(SMALL))
def test_the_second_moment_is_unbiased(name):
    """E[Ẑ² (1 - V)] = Z², also where N is so small that Ẑ is far from normal."""
    filter, observations = SMALL[name]
    _, log_evidence, variances = many(filter, observations, 3000)
    ratios = np.exp(log_evidence - exact_evidence(getattr(filter.model, "num_objects", 1)))
    relative = np.sqrt(1 + 2 * variances) - 1  # what is returned is V + V² / 2
    estimates = ratios**2 * (1 - relative)
    standard_error = estimates.std() / np.sqrt(len(estimates))
    # Loose estimates would prove nothing: without the factors of the pairs it is off by more.
    assert standard_error < 0.05
    assert abs(estimates.mean() - 1) < 4 * standard_error


SQUARES = np.array([1.2, 0.8, 1.5, 1.0, 0.6, 0.9, 1.1, 1.3], np.float32)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("filter", "observations"),
    [
        *thorough([(mpfjax.particle_filter(ONE, 1000, **DRAWS), np.sin(np.arange(8.0))[:, None])]),
        (labelled(SQUARE, 1000, regrouping=KMeans(), m=2), SQUARES),
    ],
    ids=["pf", "mpf"],
)
def test_it_is_that_of_many_runs(filter, observations):
    runs, log_evidence, variances = many(filter, observations, 400)
    # The variance of 400 runs is known to 7%.
    assert variances.mean() / log_evidence.var() == pytest.approx(1, abs=0.2)
    assert variances.std() < variances.mean()
    errors = np.asarray(jax.vmap(mixture_weight_errors)(runs))
    if filter.num_components == 1:
        np.testing.assert_allclose(errors, 0, atol=1e-4)
        return
    means = jax.vmap(lambda mixture: mixture.component_means())(runs.final)
    masses = jax.vmap(lambda mixture: mixture.mixture_weights)(runs.final)
    # Of the mode above zero, whichever component it is.
    each, above = np.arange(len(means)), np.argmax(means, axis=1)
    masses, errors = np.asarray(masses)[each, above], errors[each, above]
    assert errors.mean() / masses.std() == pytest.approx(1, abs=0.15)
    assert errors.std() < 0.5 * errors.mean()


def exact_pairs(run):
    """Both estimates with the factor of each pair, of a chain that starts with `Resample`."""
    before = [run.initial.component_indicators, *run.collected.component_indicators]
    ancestors, resampled = np.asarray(run.collected.ancestor_indices), np.asarray(run.resampled)
    n = len(before[0])
    factors, first = np.full((n, n), n / (n - 1)), np.arange(n)
    for t, parents in enumerate(ancestors):
        labels = np.asarray(before[t])[parents]
        k = np.bincount(labels, minlength=resampled.shape[1])
        grown = np.where((k > 1) & resampled[t], k / np.maximum(k - 1, 1), 1)
        same = labels[:, None] == labels
        factors = factors[np.ix_(parents, parents)] * np.where(same, grown[labels], 1)
        first = first[parents]
    weights = np.asarray(run.final.weights, float)
    counted = factors * (first[:, None] != first)
    labels = np.asarray(run.final.component_indicators)
    excess = [weights * ((labels == m) - weights[labels == m].sum()) for m in range(3)]
    masses = [max(-u @ counted @ u, 0) ** 0.5 for u in excess]
    relative = 1 - weights @ counted @ weights
    return relative + relative**2 / 2, np.array(masses)


@pytest.mark.thorough
@pytest.mark.parametrize("num_components", [1, 3])
def test_averages_of_pairs_are_close_to_the_pairs_themselves(num_components):
    if num_components == 1:
        filter = mpfjax.particle_filter(SQUARE, 80, **DRAWS)
    else:
        filter = labelled(SQUARE, 80, regrouping=KMeans())
    run = jax.jit(lambda key, filter: mpfjax.run_filter(key, filter, SQUARES))
    found, errors = [], []
    for key in jax.random.split(jax.random.key(5), 40):
        one = run(key, with_first_ancestors(filter))
        exact, of_masses = exact_pairs(one)
        found.append((float(log_marginal_likelihood_variance(one)), exact))
        errors.append((mixture_weight_errors(one), of_masses[:num_components]))
    averaged, exact = np.array(found).T
    errors = np.array(errors)
    if num_components == 1:
        np.testing.assert_allclose(averaged, exact, atol=1e-5)
    else:
        assert averaged.mean() == pytest.approx(exact.mean(), rel=0.05)
        assert np.corrcoef(averaged, exact)[0, 1] > 0.97
        ours, theirs = np.moveaxis(errors, 1, 0).reshape(2, -1)
        assert ours.mean() == pytest.approx(theirs.mean(), rel=0.05)
        assert np.corrcoef(ours, theirs)[0, 1] > 0.97
    # Online, from the mixture of each step.
    by_step = jax.vmap(log_marginal_likelihood_variance)(one.collected)
    assert float(by_step[-1]) == pytest.approx(averaged[-1])
    # Nothing else is changed.
    plain = run(key, filter)
    np.testing.assert_array_equal(plain.collected.particles, one.collected.particles)
    np.testing.assert_array_equal(plain.log_marginal_likelihood, one.log_marginal_likelihood)
    twice = with_first_ancestors(with_first_ancestors(filter))
    assert len(twice._initial_moves) == len(filter._initial_moves) + 1


@pytest.mark.thorough
def test_every_step_reports_them_and_no_other_filter_does():
    filter = with_first_ancestors(labelled(SQUARE, 80, regrouping=KMeans()))
    mixture = filter.init(jax.random.key(0))
    for t, square in enumerate(SQUARES[:3]):
        mixture, info = filter.step(jax.random.key(t), mixture, square)
        expected = mixture_weight_errors(mixture)
        np.testing.assert_allclose(info.mixture_weight_errors, expected, atol=1e-5)
        variance = float(log_marginal_likelihood_variance(mixture))
        assert float(info.log_marginal_likelihood_error) == pytest.approx(variance**0.5, rel=1e-3)
    assert float(expected.max()) > 0.01
    # Of every step of a run, at no cost to a run that does not ask.
    run = mpfjax.run_filter(jax.random.key(0), filter, SQUARES, mixture_weight_errors)
    assert run.collected.shape == (len(SQUARES), 3)
    plain = mpfjax.particle_filter(SQUARE, 80)
    _, info = plain.step(jax.random.key(0), plain.init(jax.random.key(1)), SQUARES[0])
    assert info.mixture_weight_errors is None
    assert info.log_marginal_likelihood_error is None


@pytest.mark.thorough
def test_a_run_in_more_slots_than_particles_counts_its_particles():
    filter = with_first_ancestors(mpfjax.particle_filter(ONE, 30, **DRAWS))
    keys = jax.random.split(jax.random.key(2), 400)
    runs = [mpfjax.monte_carlo(keys, filter, SEEN, nothing, slots=slots) for slots in (None, 37)]
    means = [float(jnp.mean(jax.vmap(log_marginal_likelihood_variance)(run))) for run in runs]
    assert means[0] == pytest.approx(means[1], rel=0.2)


def test_one_step_nothing_seen_and_zero_likelihood():
    filter = with_first_ancestors(mpfjax.particle_filter(SQUARE, 40, **DRAWS))
    one = mpfjax.run_filter(jax.random.key(1), filter, SQUARES[:1])
    assert np.isfinite(log_marginal_likelihood_variance(one))
    unseen = mpfjax.run_filter(jax.random.key(1), filter, np.full(3, np.nan), missing="skip")
    assert float(log_marginal_likelihood_variance(unseen)) == pytest.approx(0, abs=1e-6)
    lost = mpfjax.run_filter(jax.random.key(1), filter, np.float32([1.0, 1e30, 1.0]))
    assert lost.degenerate.any()
    assert float(log_marginal_likelihood_variance(lost)) == np.inf


@pytest.mark.usefixtures("as_installed")
class TestBadInput:
    @pytest.mark.parametrize(
        "filter",
        [
            None,
            mpfjax.gaussian_particle_filter(ONE, 20),
            mpfjax.distributed_partitioned_sampling(OBJECTS, 20),
            mpfjax.independent_particle_filters(OBJECTS, 20),
            Filter(ONE, [lambda key, mixture, observation: mixture], 20),
        ],
    )
    def test_filters_without_single_ancestors(self, filter):
        with pytest.raises(ValueError, match="filter: "):
            with_first_ancestors(filter)

    @pytest.mark.parametrize(
        "filter",
        [
            mpfjax.particle_filter(ONE, 20),
            mpfjax.particle_filter(ONE, 20, scheme="ssp"),
            mpfjax.particle_filter(ONE, 20, scheme="multinomial", noise="rqmc"),
            mpfjax.auxiliary_particle_filter(ONE, 20, lambda seen, states: 0 * states[:, 0]),
            mpfjax.distributed_partitioned_sampling(OBJECTS, 20, reassembly="evidence"),
            Filter(ONE, [Every(2, [Resample("stratified")]), Propagate(ONE)], 20),
        ],
    )
    def test_filters_whose_draws_are_not_independent(self, filter):
        with pytest.raises(ValueError, match=r"filter: (scheme|noise|initial_noise) of \w+ is '"):
            with_first_ancestors(filter)

    def test_runs_without_first_ancestors(self):
        filter = mpfjax.particle_filter(SQUARE, 20, **DRAWS)
        plain = mpfjax.run_filter(jax.random.key(0), filter, SQUARES)
        keys = jax.random.split(jax.random.key(0), 2)
        several = mpfjax.monte_carlo(keys, with_first_ancestors(filter), SQUARES)

        def first(mixture):
            return mixture.memory["eve_indices"].indices

        mixture = with_first_ancestors(filter).init(jax.random.key(0))
        # The memory of islands keeps a leading axis.
        islands = eqx.tree_at(first, mixture, first(mixture).reshape(2, -1))
        for run, why in (
            (None, "no FilterRun"), (plain, "first ancestors"), (several, "jax.vmap"),
            (islands, "islands"),
        ):  # fmt: skip
            for estimate in (log_marginal_likelihood_variance, mixture_weight_errors):
                with pytest.raises(ValueError, match=f"run: .*{why}"):
                    estimate(run)
