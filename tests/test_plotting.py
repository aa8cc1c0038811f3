"""What figures show: the moments of components."""

import equinox as eqx
import jax
import numpy as np
import pytest
from matplotlib.collections import LineCollection

import mpfjax
from mpfjax.plotting import draw_components
from tests.switching import MODEL as SWITCHING
from tests.switching import OBSERVATIONS as SEEN


def segments_of(collection):
    return collection.get_segments() if isinstance(collection, LineCollection) else []


@pytest.mark.exactness
def test_components_stand_where_their_moments_are():
    """A dot at each living component's mean; bars hold deviations within particles and between."""
    by_regime = [mpfjax.GroupBy(lambda state: state.latent)]
    moves = [mpfjax.PropagateMarginalised(), mpfjax.Resample(), *by_regime]
    filter = mpfjax.Filter(SWITCHING, moves, 40, 3, initial_moves=by_regime)
    mixtures = mpfjax.run_filter(jax.random.key(2), filter, SEEN).collected
    axis = draw_components(mixtures, 1, truth=np.zeros(len(SEEN))).axes[0]
    bars = [path[:, 1] for each in axis.collections for path in segments_of(each)]
    last = jax.tree.map(lambda leaf: leaf[-1], mixtures)
    alive = np.flatnonzero(last.mixture_weights >= 0.01)
    means = np.asarray(last.component_means().mean)[alive, 0]
    deviations = np.sqrt(np.asarray(last.component_means().covariance)[alive, 0, 0])
    for mean, deviation in zip(means, deviations, strict=True):
        expected = [mean - 2 * deviation, mean + 2 * deviation]
        assert any(np.allclose(bar, expected, rtol=1e-3) for bar in bars)
    masses = jax.vmap(lambda mixture: mixture.mixture_weights)(mixtures)
    assert len(bars) == np.sum(masses >= 0.01) < np.sum(masses > 0)


def test_a_mass_that_rounding_left_above_one_is_drawn():
    filter = mpfjax.particle_filter(mpfjax.QuadraticModel(0.3, 0.5, -2.0, 2.0), 10)
    mixtures = mpfjax.run_filter(jax.random.key(0), filter, np.ones(2, np.float32)).collected
    mixtures = eqx.tree_at(lambda m: m.log_weights, mixtures, mixtures.log_weights + 1e-6)
    assert np.all(jax.vmap(lambda mixture: mixture.mixture_weights)(mixtures) > 1)
    assert draw_components(mixtures).axes[0].collections
