"""What a run shows of itself: moments over time, a table of its components, its text."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from tests.switching import MODEL as SWITCHING
from tests.switching import OBSERVATIONS
from tests.user_models import ScalarLinear

SEEN = jnp.array([2.0, 2.5, 2.0])


class TwoPlaces(mpfjax.AbstractStateSpaceModel):
    """A place whose square is observed, and an angle that turns about pi."""

    noise: jax.Array = eqx.field(converter=jnp.asarray, default=0.25)

    @property
    def periods(self):
        return {"place": 0.0, "angle": 2 * jnp.pi}

    def sample_initial(self, key, num_particles):
        keys = jax.random.split(key)
        angle = jnp.pi + 0.1 * jax.random.normal(keys[1], (num_particles,))
        return {"place": jax.random.normal(keys[0], (num_particles,)), "angle": angle}

    def sample_transition(self, key, states):
        step = 0.1 * jax.random.normal(key, states["place"].shape)
        angle = jnp.where(states["angle"] > jnp.pi, -1, 1) * 2 * jnp.pi + states["angle"]
        return {"place": states["place"] + step, "angle": angle}

    def log_likelihood(self, observation, states):
        return -0.5 * ((observation - states["place"] ** 2) / self.noise) ** 2


FILTER = mpfjax.mixture_particle_filter(TwoPlaces(), 100, 6, features=lambda s: s["place"])


@pytest.fixture(scope="module")
def run():
    return mpfjax.run_filter(jax.random.key(0), FILTER, SEEN)


def at(mixtures, *index):
    return jax.tree.map(lambda leaf: leaf[index], mixtures)


def test_moments_of_each_step_are_those_of_its_mixture(run):
    means, variances, quantiles = run.mean(), run.variance(), run.quantile([0.1, 0.9])
    middles = run.quantile(0.5, lambda states: states["place"] ** 2)
    for t in range(3):
        mixture = at(run.collected, t)
        place, weights = mixture.particles["place"], mixture.weights
        np.testing.assert_allclose(means["place"][t], weights @ place, rtol=1e-4, atol=1e-5)
        spread = weights @ (place - weights @ place) ** 2
        np.testing.assert_allclose(variances["place"][t], spread, rtol=1e-4)
        low_and_high = mixture.quantile(place, [0.1, 0.9])
        np.testing.assert_allclose(quantiles["place"][t], low_and_high, rtol=1e-5)
        np.testing.assert_allclose(middles[t], mixture.quantile(place**2, 0.5), rtol=1e-5)
    # On the circle, half of the particles would otherwise be 2 pi away.
    assert np.all(variances["angle"] < 0.1)


def test_runs_of_many_keys_have_moments_of_each():
    keys = jax.random.split(jax.random.key(1), 2)
    filter = mpfjax.particle_filter(ScalarLinear(), 20)
    runs = mpfjax.monte_carlo(keys, filter, SEEN)
    assert runs.mean().shape == (2, 3)
    assert runs.quantile([0.1, 0.5, 0.9]).shape == (2, 3, 3)
    np.testing.assert_allclose(runs.mean()[1, 2], at(runs.collected, 1, 2).mean(), rtol=1e-5)
    assert "2 runs of 3 steps" in repr(runs)
    assert "component" not in repr(runs)


def test_variance_of_a_marginalised_state_holds_that_within_particles():
    filter = mpfjax.Filter(SWITCHING, [mpfjax.PropagateMarginalised(), mpfjax.Resample()], 40)
    run = mpfjax.run_filter(jax.random.key(2), filter, OBSERVATIONS)
    _, variance = run.variance()
    expected = jax.vmap(jnp.diag)(run.mean().covariance)
    np.testing.assert_allclose(variance, expected, rtol=1e-4)
    with pytest.raises(ValueError, match="values: None"):
        run.quantile(0.5)


def test_a_table_shows_the_living_components_alone(run):
    table = mpfjax.component_table(run.final)
    weights = np.asarray(run.final.mixture_weights)
    assert 2 <= len(table.rows) == np.sum(weights > 0) < 6
    assert table.columns[3:] == ("x['angle'] (mean ± sd)", "x['place'] (mean ± sd)")
    heaviest = int(np.argmax(weights))
    assert table.rows[0][:2] == (str(heaviest), f"{weights[heaviest]:.3f}")
    mean, deviation = table.rows[0][4].split(" ± ")
    found = float(run.final.component_means()["place"][heaviest])
    assert float(mean) == pytest.approx(found, abs=0.01)
    assert len(mean.partition(".")[2]) == len(deviation.partition(".")[2])
    text, page = repr(run), run._repr_html_()
    assert "run of 3 steps: log Z = " in text
    assert str(table) in text
    assert "nan" not in text
    assert page.count("<tr>") == len(table.rows) + 1


def test_a_filter_shows_the_parameters_of_its_model():
    text = repr(FILTER)
    assert "TwoPlaces(noise=0.25)" in text
    assert "num_particles=100" in text
