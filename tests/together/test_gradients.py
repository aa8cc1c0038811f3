"""The scores of the filters: the derivatives of log Ẑ against those of the Kalman filter."""

import chex
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax import Filter, Propagate, Resample, Step, with_score_gradient
from mpfjax.exact import kalman_filter
from mpfjax.moves.propagation.propagate import Predict, Reweight
from tests.examples import example_mixtures
from tests.marking import quick_of, weekly
from tests.unbiased import assert_unbiased
from tests.user_models import BLINDED, ScalarLinear

NUM_PARTICLES, NUM_RUNS = 48, 1000
MODEL = ScalarLinear()
TWO = jnp.array([[1.5, -0.4], [1.0, 0.3], [0.4, 1.2], [0.9, 0.8]])  # of two objects
ONE = TWO[:, :1]


def joint(make, **options):
    return lambda model: make(mpfjax.MultiObjectModel(model, 2), NUM_PARTICLES, **options)


def single(make, *sizes, **options):
    return lambda model: make(model, NUM_PARTICLES, *sizes, **options)


def guided(model):
    proposal = mpfjax.GaussNewtonProposal()
    return mpfjax.particle_filter(model, NUM_PARTICLES, proposal=proposal)


def own(*moves):
    return lambda model: Filter(model, moves, NUM_PARTICLES)


RESAMPLE = Resample("multinomial", ess_threshold=0.5)


def pathwise(model):
    """Stop-gradient resampling of particles that are differentiated through their draws."""
    return Filter(model, [Resample(gradient="stop"), Propagate()], NUM_PARTICLES)


WITH_GAP = ONE.at[1].set(jnp.nan)
# A filter, before its gradient is chosen, and the observations.
FILTERS = {
    "mpf": (single(mpfjax.mixture_particle_filter, 2, ess_threshold=0.7), ONE),
    "pf": (single(mpfjax.particle_filter), ONE),
    "mpf rqmc": (single(mpfjax.mixture_particle_filter, 2, noise="rqmc"), ONE),
    "guided pf": (guided, ONE),
    "pathwise": (pathwise, ONE),
    "walk": (own(Propagate(), RESAMPLE, mpfjax.RandomWalkMetropolis()), ONE),
    "halves, one missing": (own(RESAMPLE, Predict(), Reweight()), WITH_GAP),
    "ps": (joint(mpfjax.partitioned_sampling, order=(1, 0)), TWO),
    "dps": (
        joint(
            mpfjax.distributed_partitioned_sampling, reassembly="evidence"
        ), TWO,
    ),
}  # fmt: skip


def deviations(name, transform):
    """How many standard errors E[Ẑ/Z ∇log Ẑ] is from the exact score, for every parameter."""
    make, observations = FILTERS[name]

    def log_evidence(model, key):
        filter = transform(make(model))
        seen = observations if filter.model is not model else observations[:, 0]
        run = mpfjax.run_filter(key, filter, seen, lambda mixture: None, missing="skip")
        return run.log_marginal_likelihood

    def exact_log_evidence(model):
        series = [mpfjax.Series.skipping(column[:, None]) for column in observations.T]
        runs = [kalman_filter(model.in_matrices(), one) for one in series]
        return sum(run.log_marginal_likelihood for run in runs)

    score = eqx.filter_jit(jax.vmap(eqx.filter_value_and_grad(log_evidence), in_axes=(None, 0)))
    logs, slopes = score(MODEL, jax.random.split(jax.random.key(0), NUM_RUNS))
    exact, exact_slopes = eqx.filter_value_and_grad(exact_log_evidence)(MODEL)
    ratios = np.exp(np.asarray(logs - exact, float))
    assert_unbiased(ratios, loosest=0.04)
    found = {}
    for field in "aqhrmp":
        values = ratios * np.asarray(getattr(slopes, field), float)
        error = values.std() / np.sqrt(NUM_RUNS)
        found[field] = float((values.mean() - getattr(exact_slopes, field)) / error)
    return found


@pytest.mark.exactness
@pytest.mark.parametrize("name", quick_of(FILTERS, ["pf", "mpf"], one_in=8))
def test_stop_gradient_scores_are_unbiased(name):
    """∇Ẑ = Ẑ ∇log Ẑ is an unbiased estimate of ∇Z, for any number of particles."""
    found = deviations(name, (lambda f: f) if name == "pathwise" else with_score_gradient)
    assert max(map(abs, found.values())) < 4, found


@pytest.mark.exactness
def test_plain_derivatives_are_biased():
    found = deviations("pf", lambda filter: filter)
    assert max(map(abs, found.values())) > 10, found


MOVES = {
    "resampling": lambda gradient: Resample(ess_threshold=0.5, gradient=gradient),
    "bootstrap": lambda gradient: Propagate(gradient=gradient),
    "guided": lambda gradient: Propagate(mpfjax.GaussNewtonProposal(), gradient=gradient),
    "halves": lambda gradient: Predict(gradient=gradient),
}


@pytest.mark.parametrize("kind", MOVES)
def test_moves_with_stopped_gradients_are_the_same_to_the_bit(kind):
    now = Step(MODEL, ONE[0, 0])
    for mixture in example_mixtures().values():
        one_dimensional = mixture.replace(particles=mixture.particles[:, 0])
        chex.assert_trees_all_equal(
            *(
                eqx.filter_jit(MOVES[kind](gradient))(jax.random.key(5), one_dimensional, now)
                for gradient in ("none", "stop")
            )
        )


class Window(mpfjax.QuadraticModel):
    """Zero likelihood, with a logarithm of -inf, for most of the particles."""

    def log_likelihood(self, observation, states):
        honest = super().log_likelihood(observation, states)
        return jnp.where(jnp.abs(observation - states**2) < 0.4, honest, -jnp.inf)


@pytest.mark.exactness
def test_gradients_are_finite_where_weights_and_components_vanish():
    """In float32, with empty slots, dead components, and a step of zero likelihood throughout."""
    observations = jnp.array([1.5, 1.0, BLINDED, 0.4, 0.9])

    def log_evidence(model):
        resample = Resample(ess_threshold=0.7, particles_per_component=4, gradient="stop")
        moves = [resample, Propagate(gradient="stop"),
                 mpfjax.Merge(2.0, max_distance=1.0, patience=2)]  # fmt: skip
        filter = Filter(model, moves, 24, 6, initial_moves=[mpfjax.RandomPartition()])
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


def mixture_of(model, m):
    return with_score_gradient(mpfjax.mixture_particle_filter(model, NUM_PARTICLES, m))


def gaussian_mixture_of(model, m):
    return mpfjax.gaussian_mixture_particle_filter(model, NUM_PARTICLES, m)


# On either side of the number of components up to which sums are unrolled. What is an index, a
# label or a shift is a constant in every order of differentiating.
@pytest.mark.exactness
@pytest.mark.parametrize(
    ("make", "m"), [(mixture_of, 3), *weekly([(mixture_of, 6), (gaussian_mixture_of, 6)])]
)
def test_first_and_second_derivatives_are_the_same_in_both_modes(make, m):
    def log_evidence(sigma):
        filter = make(mpfjax.QuadraticModel(sigma, 0.5, -2.0, 2.0), m)
        run = mpfjax.run_filter(jax.random.key(0), filter, ONE[:2, 0] ** 2, lambda mixture: None)
        return run.log_marginal_likelihood

    @jax.jit
    def derivatives(sigma):
        """First and second, forward over reverse and forward over forward."""
        modes = jax.grad(log_evidence), jax.jacfwd(log_evidence)
        return [jax.jvp(first, (sigma,), (jnp.ones_like(sigma),)) for first in modes]

    for reverse, forward in zip(*derivatives(jnp.asarray(0.3)), strict=True):
        assert np.isfinite(reverse)
        assert float(reverse) == pytest.approx(float(forward), rel=1e-3)
