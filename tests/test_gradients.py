"""The scores of the filters: the derivatives of log Ẑ against those of the Kalman filter."""

from functools import cache

import chex
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax.exact import kalman_filter
from mpfjax.moves.propagation.propagate import Predict, Reweight
from tests.examples import example_mixtures
from tests.marking import quick_of, thorough
from tests.user_models import BLINDED, Batched, ScalarLinear

NUM_PARTICLES = 48
NUM_RUNS = 1000
MODEL = ScalarLinear()
PARAMETERS = tuple("aqhrmp")
TWO = jnp.array([[1.5, -0.4], [1.0, 0.3], [0.4, 1.2], [0.9, 0.8]])  # of two objects
ONE = TWO[:, 0]


def joint(make, **options):
    def build(model, gradient):
        filter = make(mpfjax.MultiObjectModel(model, 2), NUM_PARTICLES, **options)
        return mpfjax.with_score_gradient(filter) if gradient == "stop" else filter

    return build


def single(make, *sizes, **options):
    return lambda model, gradient: make(model, *sizes, gradient=gradient, **options)


def guided(model, gradient, **options):
    proposal = mpfjax.GaussNewtonProposal(model)
    return mpfjax.particle_filter(model, NUM_PARTICLES, proposal=proposal, gradient=gradient)


def pathwise(model, gradient):
    """Stop-gradient resampling of particles that are differentiated through their draws."""
    resample = mpfjax.Resample(gradient=gradient)
    return mpfjax.Filter(model, [resample, mpfjax.Propagate(model)], NUM_PARTICLES)


FILTERS = {
    "pf": single(mpfjax.particle_filter, NUM_PARTICLES),
    "mpf": single(mpfjax.mixture_particle_filter, NUM_PARTICLES, 2, ess_threshold=0.7),
    "mpf rqmc": single(mpfjax.mixture_particle_filter, NUM_PARTICLES, 2, noise="rqmc"),
    "guided pf": guided,
    "pathwise": pathwise,
    "ps": joint(mpfjax.partitioned_sampling, order=(1, 0)),
    "dps": joint(mpfjax.distributed_partitioned_sampling, reassembly="evidence", ess_threshold=0.7),
}


def nothing(mixture):
    return None


def observations_of(filter):
    return TWO if isinstance(filter.model, mpfjax.MultiObjectModel) else ONE


@cache
def scores(name, gradient):
    """log Ẑ and its derivatives by the model's parameters, over many runs."""

    def log_evidence(model, key):
        filter = FILTERS[name](model, gradient)
        run = mpfjax.run_filter(key, filter, observations_of(filter), nothing)
        return run.log_marginal_likelihood

    score = eqx.filter_jit(jax.vmap(eqx.filter_value_and_grad(log_evidence), in_axes=(None, 0)))
    return jax.tree.map(np.asarray, score(MODEL, jax.random.split(jax.random.key(0), NUM_RUNS)))


def exact_log_evidence(model, observations):
    """log Z of independent objects, one a column."""
    model = model.in_matrices()
    runs = [kalman_filter(model, column[:, None]) for column in observations.T]
    return sum(run.log_marginal_likelihood for run in runs)


@cache
def truth(name):
    observations = TWO if name.split()[0] in ("ps", "dps") else TWO[:, :1]
    found = eqx.filter_value_and_grad(exact_log_evidence)(MODEL, observations)
    return jax.tree.map(np.asarray, found)


def deviations(name, gradient):
    """How many standard errors E[Ẑ/Z ∇log Ẑ] is from the exact score, for every parameter."""
    log_evidence, score = scores(name, gradient)
    exact, exact_score = truth(name)
    ratios = np.exp(log_evidence - exact)
    assert ratios.std() / np.sqrt(NUM_RUNS) < 0.04
    return {
        field: standard_errors(ratios * getattr(score, field), getattr(exact_score, field))
        for field in PARAMETERS
    }


def standard_errors(values, expected):
    """How many of them the mean of the values is from what is expected."""
    return float((values.mean() - expected) / (values.std() / np.sqrt(len(values))))


@pytest.mark.parametrize("name", quick_of(FILTERS, ["mpf"]))
def test_stop_gradient_scores_are_unbiased(name):
    """∇Ẑ = Ẑ ∇log Ẑ is an unbiased estimate of ∇Z, for any number of particles."""
    found = deviations(name, "stop")
    assert max(map(abs, found.values())) < 4, found


def test_plain_derivatives_are_biased():
    found = deviations("pathwise", "none")
    assert max(map(abs, found.values())) > 10, found


@pytest.mark.thorough
@pytest.mark.parametrize(
    "options", [{"ess_threshold": 0.5}, *thorough([{}, {"scheme": "residual"}])]
)
def test_resampling_with_stopped_gradients_is_the_same_to_the_bit(options):
    for mixture in example_mixtures().values():
        moved = [
            eqx.filter_jit(mpfjax.Resample(gradient=gradient, **options))(
                jax.random.key(5), mixture
            )
            for gradient in ("none", "stop")
        ]
        chex.assert_trees_all_equal(*moved)


@pytest.mark.parametrize("kind", ["bootstrap", "guided", "halves", "partitioned"])
def test_propagation_with_stopped_gradients_is_the_same_to_the_bit(kind):
    joint = mpfjax.MultiObjectModel(MODEL, 2)
    make = {
        "bootstrap": lambda gradient: mpfjax.Propagate(MODEL, None, gradient),
        "guided": lambda gradient: mpfjax.Propagate(
            MODEL, mpfjax.GaussNewtonProposal(MODEL), gradient
        ),
        "halves": lambda gradient: Predict(MODEL, gradient),
        "partitioned": lambda gradient: mpfjax.Partitioned(
            joint, resample=mpfjax.Resample(gradient=gradient, allocation="equal")
        ),
    }[kind]
    model, observation = (joint, TWO[0]) if kind == "partitioned" else (MODEL, ONE[0])
    moves = [make("none"), Reweight(model)]
    mixture = mpfjax.Filter(model, moves, NUM_PARTICLES).init(jax.random.key(6))
    moved = [
        eqx.filter_jit(make(gradient))(jax.random.key(7), mixture, observation)
        for gradient in ("none", "stop")
    ]
    chex.assert_trees_all_equal(*moved)


@pytest.mark.thorough
def test_steps_without_an_observation_keep_the_score_unbiased():
    observations = ONE.at[1].set(jnp.nan)

    def log_evidence(model, key):
        resample = mpfjax.Resample("multinomial", 0.5, gradient="stop")
        moves = [resample, Predict(model, "stop")]
        filter = mpfjax.Filter(model, [*moves, Reweight(model)], NUM_PARTICLES)
        run = mpfjax.run_filter(key, filter, observations, nothing, missing="skip")
        return run.log_marginal_likelihood

    def exact(model):
        """Two steps of the dynamics in one where the second observation is missing."""
        model, rows = model.in_matrices(), ONE[:, None]
        first = kalman_filter(model, rows[:1])
        twice = (model.A @ model.A, model.Q + model.A @ model.Q @ model.A.T, model.H, model.R)
        third = kalman_filter(after(first, *twice), rows[2:3])
        last = kalman_filter(after(third, model.A, model.Q, model.H, model.R), rows[3:])
        return sum(run.log_marginal_likelihood for run in (first, third, last))

    def after(run, *matrices):
        return mpfjax.LinearGaussianModel(*matrices, run.means[-1], run.covariances[-1])

    expected, expected_score = eqx.filter_value_and_grad(exact)(MODEL)
    score = eqx.filter_jit(jax.vmap(eqx.filter_value_and_grad(log_evidence), in_axes=(None, 0)))
    log_evidences, found = score(MODEL, jax.random.split(jax.random.key(2), NUM_RUNS))
    ratios = np.exp(np.asarray(log_evidences) - expected)
    for field in PARAMETERS:
        values = ratios * np.asarray(getattr(found, field))
        assert abs(standard_errors(values, getattr(expected_score, field))) < 4


class Window(mpfjax.QuadraticModel):
    """Zero likelihood, with a logarithm of -inf, for most of the particles."""

    def log_likelihood(self, observation, states):
        honest = super().log_likelihood(observation, states)
        return jnp.where(jnp.abs(observation - states**2) < 0.4, honest, -jnp.inf)


def test_gradients_are_finite_where_weights_and_components_vanish():
    """In float32, with empty slots, dead components, and a step of zero likelihood throughout."""
    observations = jnp.array([1.5, 1.0, BLINDED, 0.4, 0.9])

    def log_evidence(model):
        resample = mpfjax.Resample("systematic", 0.7, 4, gradient="stop")
        propagate = mpfjax.Propagate(model, None, "stop")
        partition = [mpfjax.RandomPartition()]
        filter = mpfjax.Filter(model, [resample, propagate], 24, 6, initial_moves=partition)
        run = mpfjax.run_filter(jax.random.key(6), filter, observations)
        seen = jnp.isfinite(run.log_likelihood_increments)
        return jnp.sum(jnp.where(seen, run.log_likelihood_increments, 0.0)), run

    score = eqx.filter_jit(eqx.filter_grad(log_evidence, has_aux=True))
    grads, run = score(Window(0.3, 0.5))
    assert run.degenerate.tolist() == [False, False, True, False, False]
    assert (np.asarray(run.collected.log_weights)[-1] == -np.inf).any()
    assert not np.asarray(run.final.active).all()
    for leaf in (grads.sigma_x, grads.sigma_y):
        assert leaf.dtype == jnp.float32
        assert np.isfinite(leaf)
        assert leaf != 0


@pytest.mark.parametrize(
    "make",
    [
        lambda model: mpfjax.particle_filter(model, 10, gradient="stop"),
        lambda model: mpfjax.mixture_particle_filter(model, 10, 2, gradient="stop"),
        lambda model: mpfjax.Propagate(model, gradient="stop"),
        lambda model: Predict(model, gradient="stop"),
        lambda model: mpfjax.run_filter(
            jax.random.key(0),
            mpfjax.with_score_gradient(
                mpfjax.partitioned_sampling(mpfjax.MultiObjectModel(model, 2), 10)
            ),
            jnp.ones((2, 2)),
        ),
    ],
)
def test_a_model_without_the_density_is_refused(make):
    with pytest.raises(ValueError, match="Batched defines no log_transition, which gradient="):
        make(Batched())


def test_an_unknown_gradient_is_refused_by_name():
    with pytest.raises(ValueError, match="gradient: 'soft' is not one of"):
        mpfjax.Resample(gradient="soft")
    with pytest.raises(ValueError, match="gradient: 'soft' is not one of"):
        mpfjax.Propagate(MODEL, gradient="soft")


REGROUPED = {
    "mpf": lambda model, m, gradient: mpfjax.mixture_particle_filter(
        model, NUM_PARTICLES, m, gradient=gradient
    ),
    "gm-mpf": lambda model, m, gradient: mpfjax.gaussian_mixture_particle_filter(
        model, NUM_PARTICLES, m
    ),
}


def log_evidence_by_sigma(make, gradient, m):
    def log_evidence(sigma):
        filter = REGROUPED[make](mpfjax.QuadraticModel(sigma, 0.5, -2.0, 2.0), m, gradient)
        run = mpfjax.run_filter(jax.random.key(0), filter, ONE[:2] ** 2, nothing)
        return run.log_marginal_likelihood

    return log_evidence


# On either side of the number of components up to which sums are unrolled. What is an index, a
# label or a shift is a constant in every order of differentiating.
@pytest.mark.parametrize(
    ("make", "gradient", "m"),
    thorough(
        [("mpf", "none", 3), ("gm-mpf", "none", 3), ("gm-mpf", "none", 6), ("mpf", "stop", 6)]
    ),
)
def test_derivatives_are_the_same_in_both_modes(make, gradient, m):
    log_evidence = log_evidence_by_sigma(make, gradient, m)
    reverse, forward = jax.jit(lambda s: (jax.grad(log_evidence)(s), jax.jacfwd(log_evidence)(s)))(
        0.3
    )
    assert np.isfinite(reverse)
    assert float(reverse) == pytest.approx(float(forward), rel=1e-3)


@pytest.mark.parametrize(("gradient", "m"), thorough([("stop", 3), ("none", 6), ("stop", 6)]))
def test_derivatives_of_second_order_are_the_same_in_both_modes(gradient, m):
    log_evidence = log_evidence_by_sigma("mpf", gradient, m)

    @jax.jit
    def derivatives(sigma):
        """First and second, forward over reverse and forward over forward."""
        modes = jax.grad(log_evidence), jax.jacfwd(log_evidence)
        return [jax.jvp(first, (sigma,), (jnp.ones_like(sigma),)) for first in modes]

    for reverse, forward in zip(*derivatives(jnp.asarray(0.3)), strict=True):
        assert np.isfinite(reverse)
        assert float(reverse) == pytest.approx(float(forward), rel=1e-3)
