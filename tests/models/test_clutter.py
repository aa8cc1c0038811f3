"""An object among clutter, against the sum over all associations."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

import mpfjax
from mpfjax import ClutteredModel, Filter, Propagate, Resample
from tests.unbiased import assert_unbiased

KEY = jax.random.key(0)
A, Q, R, P0, P_D, CLUTTER = 0.9, 0.5, 0.3, 1.0, 0.7, 0.2
OBJECT = mpfjax.LinearGaussianModel([[A]], [[Q]], [[1.0]], [[R]], [0.0], [[P0]])
MODEL = ClutteredModel(OBJECT, P_D, CLUTTER)
NAN = np.nan
# Steps with two measurements, one (in either row) and none.
SETS = np.array([[0.4, -2.0], [NAN, 0.9], [NAN, NAN], [1.5, 0.2], [-1.0, NAN]])[..., None]


def by_associations(sets, p_d=P_D, clutter=CLUTTER):
    """Z and E[x_t | y_1..y_t] by a Kalman filter for each sequence of associations."""
    total, first = 0.0, 0.0
    choices = [[None, *np.flatnonzero(~np.isnan(y))] for y in sets[..., 0]]
    for sources in itertools.product(*choices):
        mean, variance, weight = 0.0, P0, 1.0
        for own, seen in zip(sources, sets[..., 0], strict=True):
            mean, variance = A * mean, A**2 * variance + Q
            weight *= 1 - p_d if own is None else p_d / clutter
            if own is not None:
                spread = variance + R
                weight *= scipy.stats.norm.pdf(seen[own], mean, np.sqrt(spread))
                mean += variance / spread * (seen[own] - mean)
                variance *= R / spread
        total, first = total + weight, first + weight * mean
    return total, first / total


class Wide(mpfjax.AbstractProposal):
    """A guided proposal that does without a single measurement: twice the variance."""

    def propose(self, key, now, previous_states):
        noise = jax.random.normal(key, previous_states.shape)
        drawn = A * previous_states + np.float32(np.sqrt(2 * Q)) * noise
        return drawn, self.log_density(now, drawn, previous_states)

    def log_density(self, now, states, previous_states):
        gaps = states - A * previous_states
        return jnp.sum(jax.scipy.stats.norm.logpdf(gaps, scale=np.sqrt(2 * Q)), axis=1)


CHAINS = {
    "plain": Filter(MODEL, [Resample(), Propagate()], 100),
    "guided": Filter(MODEL, [Resample(), Propagate(Wide())], 100),
}


@pytest.mark.exactness
@pytest.mark.parametrize("chain", CHAINS)
def test_evidence_and_moments_are_those_of_all_associations(chain):
    exact, mean = by_associations(SETS)
    runs = mpfjax.monte_carlo(
        jax.random.split(KEY, 300), CHAINS[chain], jnp.asarray(SETS),
        collect=lambda mixture: mixture.mean()[0],
    )  # fmt: skip
    ratios = np.exp(np.asarray(runs.log_marginal_likelihood)) / exact
    assert_unbiased(ratios, loosest=0.02)
    assert_unbiased(ratios * np.asarray(runs.collected)[:, -1], mean, loosest=0.02)


@pytest.mark.exactness
def test_the_gradient_is_that_of_all_associations():
    """E[Ẑ ∂ log Ẑ] = ∂Z, for p_D and log λ, through steps without a measurement."""

    @jax.jit
    @jax.vmap
    def values(key):
        def log_evidence(parameters):
            model = ClutteredModel(OBJECT, parameters[0], jnp.exp(parameters[1]))
            filter = mpfjax.particle_filter(model, 100, gradient="stop")
            return mpfjax.run_filter(key, filter, SETS).log_marginal_likelihood

        return jax.value_and_grad(log_evidence)(jnp.array([P_D, np.log(CLUTTER)]))

    log_z, gradients = values(jax.random.split(KEY, 300))
    z, h = by_associations(SETS)[0], 1e-4
    ends = ((P_D + h, 1.0), (P_D - h, 1.0)), ((P_D, np.exp(h)), (P_D, np.exp(-h)))
    values = [[by_associations(SETS, p, c * CLUTTER)[0] for p, c in pair] for pair in ends]
    exact = -np.diff(values)[:, 0] / (2 * h * z)
    ratios = np.exp(np.asarray(log_z))[:, None] / z
    assert_unbiased(ratios * np.asarray(gradients), exact, loosest=0.05)


class Bearings:
    """Of one particle, with an input; its likelihood has no gradient where y is 0."""

    inputs, periods = None, 2 * np.pi

    def sample_initial(self, key):
        return jax.random.normal(key)

    def sample_transition(self, key, state):
        return state + self.inputs + jax.random.normal(key)

    def log_likelihood(self, observation, state):
        return jax.scipy.stats.norm.logpdf(jnp.log(observation["y"]), state) - jnp.log(
            observation["y"]
        )


@pytest.mark.exactness
def test_chances_and_densities_may_be_functions_and_measurements_trees_of_one_particle():
    def seen(state):
        return 0.9 * jnp.exp(-jnp.abs(state))

    def clutter(measurement):
        return 0.1 * measurement["y"]

    model = ClutteredModel(mpfjax.per_particle(Bearings()), seen, clutter)
    states, y = np.array([-1.0, 0.3, 2.0], np.float32), np.array([NAN, 0.5, 3.0, NAN], np.float32)
    values, gradients = jax.value_and_grad(
        lambda x: jnp.sum(model.log_likelihood({"y": jnp.asarray(y)}, x))
    )(jnp.asarray(states))
    p, measured = 0.9 * np.exp(-np.abs(states)), y[1:3, None]
    ratios = scipy.stats.norm.pdf(np.log(measured), states) / measured / (0.1 * measured)
    np.testing.assert_allclose(values, np.sum(np.log(1 - p + p * np.sum(ratios, 0))), rtol=1e-5)
    assert np.isfinite(gradients).all()
    assert model.periods == 2 * np.pi
    assert (model.with_inputs(jnp.float32(100.0)).sample_transition(KEY, jnp.zeros(3)) > 90).all()
    missed = MODEL.log_likelihood(jnp.zeros((0, 1)), jnp.zeros((1, 1)))  # no room for any
    assert missed == pytest.approx(np.log(1 - P_D))


@pytest.mark.exactness
def test_chances_of_nothing_and_of_all_have_derivatives():
    """∂ log L / ∂p of (1 - p) + p s is (s - 1) / L."""
    states, seen = jnp.array([[0.3]]), jnp.array([[0.4], [-2.0]])
    ratio = sum(np.exp(OBJECT.log_likelihood(y, states)[0]) for y in seen) / CLUTTER

    def log_likelihood(p):
        return ClutteredModel(OBJECT, p, CLUTTER).log_likelihood(seen, states)[0]

    for p in (0.0, 0.4, 1.0):
        expected = (ratio - 1) / (1 - p + p * ratio)
        np.testing.assert_allclose(jax.grad(log_likelihood)(p), expected, rtol=1e-4)
