"""More modes than labels: the surplus shares one, and no mass is lost."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax

KEY = jax.random.key(0)
MODES = np.array([-30.0, -10.0, 10.0, 30.0])
OBSERVATIONS = jnp.array([0.5, -0.5, 0.3, 0.0], jnp.float32)


class FourAlike(mpfjax.AbstractStateSpaceModel):
    """x_0 in one of four places, of which only the distance from the nearest is seen."""

    def sample_initial(self, key, num_particles):
        key_mode, key_place = jax.random.split(key)
        modes = jax.random.choice(key_mode, jnp.asarray(MODES, jnp.float32), (num_particles,))
        return modes + jax.random.normal(key_place, (num_particles,))

    def sample_transition(self, key, states):
        return states + 0.2 * jax.random.normal(key, states.shape)

    def log_likelihood(self, observation, states):
        return jax.scipy.stats.norm.logpdf(observation, jnp.mod(states, 20.0) - 10.0, 0.3)


def steps(filter):
    mixture = filter.init(KEY)
    for number, observation in enumerate(OBSERVATIONS):
        mixture, info = filter.step(jax.random.fold_in(KEY, number), mixture, observation)
    return mixture, info


@pytest.mark.parametrize(("max_components", "ran_out"), [(2, True), (12, False)])
def test_a_step_says_when_labels_ran_out(max_components, ran_out):
    filter = mpfjax.mixture_particle_filter(FourAlike(), 300, max_components, regroup_every=1)
    mixture, info = steps(filter)
    assert bool(info.labels_ran_out) == ran_out
    if ran_out:
        assert jnp.any(eqx.filter_jit(mpfjax.Split().is_diffuse)(mixture))


def test_modes_that_share_a_label_keep_their_mass():
    """E[Ẑ π_k] = Z / 4 for each of the four modes, with two labels."""
    filter = mpfjax.mixture_particle_filter(FourAlike(), 200, 2)

    def masses(mixture):
        return jnp.stack(
            [mixture.average(jnp.abs(mixture.particles - mode) < 10) for mode in MODES]
        )

    runs = mpfjax.monte_carlo(jax.random.split(KEY, 600), filter, OBSERVATIONS, masses)
    log_z = np.asarray(runs.log_marginal_likelihood, np.float64)
    gaps = np.exp(log_z - log_z.max())[:, None] * (np.asarray(runs.collected)[:, -1] - 0.25)
    errors = gaps.std(axis=0, ddof=1) / np.sqrt(len(gaps))
    assert np.all(np.abs(gaps.mean(axis=0)) < 4 * errors), gaps.mean(axis=0) / errors
    assert np.all(np.asarray(runs.collected)[:, -1].mean(axis=0) > 0.15)
