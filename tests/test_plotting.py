"""What figures show: the moments of components, weights, diagnostics, paths, parameters."""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.collections import LineCollection

import mpfjax
from mpfjax import plotting
from mpfjax.tuning.optimisation import TuningRun
from tests.switching import MODEL as SWITCHING
from tests.switching import OBSERVATIONS as SEEN

BY_REGIME = [mpfjax.GroupBy(lambda state: state.latent)]
MOVES = [mpfjax.PropagateMarginalised(), mpfjax.Resample(), *BY_REGIME]


@pytest.fixture(scope="module")
def run():
    filter = mpfjax.Filter(SWITCHING, MOVES, 40, 3, initial_moves=BY_REGIME)
    return mpfjax.run_filter(jax.random.key(2), filter, SEEN)


@pytest.fixture(autouse=True)
def ax():
    yield plt.figure().subplots()
    plt.close("all")


def segments_of(collection):
    return collection.get_segments() if isinstance(collection, LineCollection) else []


def test_components_stand_where_their_moments_are(run):
    """A dot at each living component's mean; bars hold deviations within particles and between."""
    mixtures = run.collected
    axis = plotting.draw_components(run, 1, truth=np.zeros(len(SEEN)))
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


def test_the_plane_has_an_ellipse_for_each_component_and_step(run, ax):
    assert plotting.draw_plane(run, (1, 0), ax=ax) is ax
    masses = np.asarray(jax.vmap(lambda mixture: mixture.mixture_weights)(run.collected))
    assert len(ax.patches) == np.sum(masses >= 0.01)
    # The axes of an ellipse are those of the covariance, a latent of one regime has none.
    t, m = np.argwhere(masses >= 0.01)[np.argsort(np.nonzero(masses >= 0.01)[1], kind="stable")][0]
    mixture = jax.tree.map(lambda leaf: leaf[t], run.collected)
    deviation = np.sqrt(mixture.component_covariances()[m, 1, 1])
    first = ax.patches[0]
    np.testing.assert_allclose([first.width, first.height], [4 * deviation, 0], atol=1e-3)
    assert abs(np.cos(np.radians(first.angle))) > 0.99


def test_weights_are_stacked_to_one(run, ax):
    assert plotting.draw_weights(run, ax=ax) is ax
    tops = np.max([path.vertices[:, 1].max() for c in ax.collections for path in c.get_paths()])
    np.testing.assert_allclose(tops, 1.0, rtol=1e-4)


def test_diagnostics_have_a_line_for_each_run(ax):
    keys = jax.random.split(jax.random.key(0), 2)
    filter = mpfjax.particle_filter(mpfjax.QuadraticModel(0.3, 0.5, -2.0, 2.0), 10)
    runs = mpfjax.monte_carlo(keys, filter, np.ones(3, np.float32))
    plotting.draw_diagnostics(runs, ax=ax)
    assert [len(axis.lines) for axis in ax.figure.axes] == [2, 2]
    np.testing.assert_allclose(ax.lines[1].get_ydata(), runs.effective_sample_size[1])


def test_paths_have_the_colour_of_their_mode(ax):
    paths = jnp.array([[1.0, 2.0], [-1.0, -2.0], [0.5, 1.0]])
    plotting.draw_paths(paths, np.sign(paths[:, -1]), ax=ax)
    drawn = [(line.get_color(), *line.get_ydata()) for line in ax.lines if len(line.get_ydata())]
    lower, upper = plotting.COLOURS[:2]
    assert drawn == [(lower, -1.0, -2.0), (upper, 1.0, 2.0), (upper, 0.5, 1.0)]


def test_parameters_are_drawn_over_steps(ax):
    history = {"value": np.zeros(3), "a": np.arange(3.0), "b": np.ones((3, 2))}
    tuned = TuningRun(None, {"a": np.array(2.0), "b": np.ones(2)}, 0.0, history, None, None)
    plotting.draw_tuning(tuned, ax=ax)
    assert [line.get_label() for line in ax.lines] == ["a", "b[0]", "b[1]"]
