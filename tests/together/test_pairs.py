"""All pairs of transforms, by Ẑ and the mean, beside a Kalman filter; also on islands.

The model is linear and Gaussian, with a step that has no observation. Nothing sets an alarm off, so
that restarts have the exact answer of the filter without them.
"""

import itertools

import jax
import numpy as np
import pytest

import mpfjax
from mpfjax import KMeans, Propagate, Resample
from mpfjax.exact import kalman_filter
from tests.marking import quick_of
from tests.unbiased import assert_unbiased, ratios_to
from tests.user_models import ScalarLinear


class WithDensity(ScalarLinear):
    """With the density of x_0, by which a start moves it."""

    def log_initial(self, states):
        return jax.scipy.stats.norm.logpdf(states, self.m, self.p)


A, Q, R, M0, P0 = 0.9, 0.6, 0.5, 0.5, 1.0
MODEL = WithDensity(a=A, q=Q, r=R, m=M0, p=P0)
OBSERVATIONS = np.array([0.6, np.nan, -1.1, 1.2], np.float32)
TRANSFORMS = {
    "point sets": mpfjax.with_point_sets,
    "look-ahead": mpfjax.with_lookahead,
    "two draws": lambda filter: mpfjax.with_proposals_per_particle(filter, 2),
    "start": lambda filter: mpfjax.with_selected_start(filter, 4),
    "restarts": mpfjax.with_restarts,
    "alarm": lambda filter: mpfjax.with_alarm(filter, 16),
    "stratified": lambda filter: mpfjax.with_resampling(filter, Resample("stratified")),
}
# A start by y_1 alone.
FIRST = "first observations"
NUM_RUNS, NUM_ISLANDS = 1500, 2
# In either order on one device, and in one on islands.
PAIRS = [(*pair, 1) for pair in itertools.permutations(TRANSFORMS, 2)]
PAIRS += [("restarts", "restarts", 1), ("alarm", "alarm", 1)]
PAIRS += [(*pair, NUM_ISLANDS) for pair in itertools.combinations(TRANSFORMS, 2)]
BESIDE_FIRST = ("look-ahead", "restarts", "point sets")
PAIRS += [(*pair, 1) for name in BESIDE_FIRST for pair in ((FIRST, name), (name, FIRST))]
PAIRS += [(FIRST, "restarts", NUM_ISLANDS)]
TRANSFORMS[FIRST] = lambda filter: mpfjax.with_start(filter, 1)
# Each kind of fault that there was: looks ahead, starts and islands beside restarts.
QUICK = [("start", "look-ahead", 1)]


LINEAR = mpfjax.LinearGaussianModel(
    *(np.array([[each]]) for each in (A, Q**2, 1.0, R**2)), np.array([M0]), np.array([[P0**2]])
)


def filter_of(pair):
    filter = mpfjax.Filter(
        MODEL, [Resample(), Propagate(), KMeans(1)], 40, 2, initial_moves=[KMeans(1, reseed=True)]
    )
    for name in pair:
        filter = TRANSFORMS[name](filter)
    return filter


def mean_of(mixture):
    return mixture.average(mixture.particles)


@pytest.mark.filterwarnings("ignore:at the end, what was observed")
@pytest.mark.parametrize(("first", "second", "islands"), quick_of(PAIRS, QUICK, one_in=16))
def test_evidence_and_mean_are_exact(first, second, islands):
    pair = first, second
    filter, series = filter_of(pair), mpfjax.Series.skipping(OBSERVATIONS)
    keys = jax.random.split(jax.random.key(0), NUM_RUNS)

    def run_islands(key):
        return mpfjax.run_islands(key, filter, series, mean_of, num_islands=NUM_ISLANDS)

    if islands == 1:
        run = mpfjax.monte_carlo(keys, filter, series, mean_of)
        means = run.collected[:, -1]
    else:
        run = jax.jit(jax.vmap(run_islands))(keys)
        means = run.collected[:, -1].sum(axis=1)
    exact = kalman_filter(LINEAR, mpfjax.Series.skipping(OBSERVATIONS[:, None]))
    ratios = ratios_to(exact, run)
    assert_unbiased(ratios, loosest=0.03)
    assert_unbiased(ratios * np.asarray(means), float(exact.means[-1, 0]), loosest=0.03)
