"""Conditional SMC leaves the smoothing distribution as it is: few particles, any grouping."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax import Filter, KMeans, Merge, Propagate, RandomPartition, Resample, Split
from mpfjax.moves.propagation.propagate import Predict, Reweight
from mpfjax.smoothing import conditional_filter
from tests.marking import quick_of
from tests.smoothing.exact_smoothers import grid_smoother, grid_trajectories

NUM_CHAINS = 4000
LINEAR = mpfjax.LinearGaussianModel(
    A=[[0.9]], Q=[[0.3]], H=[[1.0]], R=[[0.4]], m0=[0.5], P0=[[1.0]]
)
QUADRATIC = mpfjax.QuadraticModel(0.4, 0.5, -2.0, 2.0)
SQUARES = np.array([1.2, 0.3, 0.8, 1.6], np.float32)
GRID = np.linspace(-4.0, 4.0, 321)
GUIDED = mpfjax.GaussNewtonProposal(LINEAR, num_iterations=1)
EAGER = (Merge(2.0), Split(1.0, 0.1, min_share=0.0), KMeans(2))


def chain(*moves, n, m, model=QUADRATIC):
    return Filter(model, moves, n, m, initial_moves=[KMeans(2, reseed=True)])


# A filter, and whether the new trajectory is from backward sampling.
CASES = {
    "guided, eager mixture, systematic": (
        chain(
            Resample(), Propagate(QUADRATIC, mpfjax.GaussNewtonProposal(QUADRATIC, 2)), *EAGER,
            n=8, m=3,
        ),
        True,
    ),
    "many components, sorted, of fixed number": (
        chain(
            Resample("stratified", particles_per_component=2, sort_by=lambda x: -x),
            Predict(QUADRATIC), Reweight(QUADRATIC), RandomPartition(4), n=11, m=5,
        ),
        False,
    ),
    "looking ahead, adaptive": (
        chain(
            mpfjax.AuxiliaryResample(Resample("stratified", 0.7), lambda y, x: -((y - x**2) ** 2)),
            Propagate(QUADRATIC), *EAGER, n=8, m=3,
        ),
        True,
    ),
    "resampled every second step": (
        chain(mpfjax.Every(2, [Resample("ssp"), KMeans(2)]), Propagate(QUADRATIC), n=8, m=3),
        True,
    ),
}  # fmt: skip


@functools.cache
def exact_draws():
    """Trajectories drawn from the smoothing distribution itself, on a grid."""
    rng = np.random.default_rng(0)
    points = jnp.asarray(GRID, jnp.float32)
    log_initial = np.where(np.abs(GRID) <= 2, 0.0, -np.inf)
    log_transition = -0.5 * ((GRID[None] - GRID[:, None]) / 0.4) ** 2
    log_likelihoods = np.array(
        [np.asarray(QUADRATIC.log_likelihood(jnp.asarray(y), points), float) for y in SQUARES]
    )
    smoothed, pairs = grid_smoother(log_initial, log_transition, log_likelihoods)
    return grid_trajectories(rng, NUM_CHAINS, GRID, smoothed, pairs)


@functools.cache
def renewed(name):
    """One call for each exact trajectory."""
    filter, backward = CASES[name]

    @jax.jit
    @jax.vmap
    def one(key, trajectory):
        return conditional_filter(key, filter, jnp.asarray(SQUARES), trajectory, backward=backward)

    keys = jax.random.split(jax.random.key(1), NUM_CHAINS)
    before = exact_draws()
    return before, jax.tree.map(np.asarray, one(keys, jnp.asarray(before)))


def statistics(trajectories):
    """x_s, x_s², and x_{s-1} x_s: the last tells trajectories that jump between modes."""
    x = trajectories.reshape(NUM_CHAINS, -1).astype(float)
    return np.concatenate([x, x**2, x[:, 1:] * x[:, :-1]], axis=1)


@pytest.mark.parametrize("name", quick_of(CASES, ["many components, sorted, of fixed number"]))
class TestInvariance:
    def test_exact_draws_stay_exact(self, name):
        """The mean change of every moment is zero, within four standard errors."""
        before, found = renewed(name)
        change = statistics(found.trajectory) - statistics(before)
        error = change.std(axis=0) / np.sqrt(NUM_CHAINS)
        assert (error < 0.05 * statistics(before).std(axis=0)).all()
        z = change.mean(axis=0) / error
        assert np.abs(z).max() < 4, z

    def test_the_kept_trajectory_stands_in_its_slots(self, name):
        before, found = renewed(name)
        collected, slots = found.run.collected, found.slots
        states = np.concatenate([found.run.initial.particles[:, None], collected.particles], axis=1)
        rows, times = np.indices(slots.shape)
        np.testing.assert_array_equal(states[rows, times, slots], before)
        assert found.possible.all()
        rows, times = np.indices(slots[:, 1:].shape)
        assert np.isfinite(collected.log_weights[rows, times, slots[:, 1:]]).all()
        ancestors = collected.ancestor_indices[rows, times, slots[:, 1:]]
        np.testing.assert_array_equal(ancestors, slots[:, :-1])

    def test_much_of_the_trajectory_is_new(self, name):
        """Backward sampling renews the start as well as the end."""
        before, found = renewed(name)
        changes = (found.trajectory != before).reshape(*found.slots.shape, -1).any(axis=2)
        by_time = changes.mean(axis=0)
        assert (by_time > (0.5 if CASES[name][1] else 0.2)).all()


@pytest.mark.thorough
def test_the_trajectory_goes_from_component_to_component():
    """So that regrouping has had a part in what is tested above."""
    _, found = renewed("guided, eager mixture, systematic")
    labels = found.run.collected.component_indicators
    rows, times = np.indices(found.slots[:, 1:].shape)
    own = labels[rows, times, found.slots[:, 1:]]
    assert (own[:, 1:] != own[:, :-1]).mean() > 0.1


class NoTransition(mpfjax.AbstractStateSpaceModel):
    def sample_initial(self, key, num_particles):
        return jax.random.uniform(key, (num_particles,))

    def sample_transition(self, key, states):
        return states + jax.random.uniform(key, states.shape)

    def log_likelihood(self, observation, states):
        return jnp.where(jnp.abs(observation - states) < 1, 0.0, -jnp.inf)


class Walled(NoTransition):
    """Steps below zero, and starts above one, are impossible."""

    def log_transition(self, states, previous_states):
        step = states - previous_states
        return jnp.where((step >= 0) & (step < 1), 0.0, -jnp.inf)

    def log_initial(self, states):
        return jnp.where((states >= 0) & (states < 1), 0.0, -jnp.inf)


ONES = np.ones(3, np.float32)


def call(trajectory=(0.5, 0.6, 0.7, 0.8), *, filter=None, observations=ONES, **options):
    filter = mpfjax.particle_filter(Walled(), 6) if filter is None else filter
    if isinstance(trajectory, tuple):
        trajectory = np.array(trajectory, np.float32)
    arguments = {"key": jax.random.key(0), "filter": filter, "observations": observations}
    return conditional_filter(**arguments | {"trajectory": trajectory} | options)


def test_nothing_but_missing_observations():
    found = call(observations=mpfjax.Series.skipping(np.full(3, np.nan, np.float32)))
    assert float(found.run.log_marginal_likelihood) == 0.0
    assert np.isfinite(found.trajectory).all()


def test_one_step_of_one_particle_is_the_trajectory_itself():
    filter = mpfjax.particle_filter(Walled(), 1)
    found = call((0.5, 0.6), filter=filter, observations=ONES[:1])
    np.testing.assert_array_equal(found.trajectory, np.float32([0.5, 0.6]))


def test_without_log_transition_the_genealogy_is_left():
    filter = mpfjax.particle_filter(NoTransition(), 6)
    assert call(filter=filter, backward=False).trajectory.shape == (4,)


@pytest.mark.usefixtures("as_installed")
class TestBadInput:
    @pytest.mark.parametrize(
        ("trajectory", "index"),
        [
            ((1.5, 1.6, 1.7, 1.8), 0),  # no x_0
            ((0.5, 0.6, 0.4, 0.8), 2),  # a step back
            ((0.9, 1.5, 1.9, 2.5), 3),  # too far from y
            ((0.5, np.nan, 0.7, 0.8), 1),
        ],
    )
    def test_a_trajectory_of_density_zero_is_named(self, trajectory, index):
        with pytest.raises(ValueError, match=f"trajectory: .*zero or NaN, first at index {index}"):
            call(trajectory)

    def test_within_jit_too(self):
        with pytest.raises(RuntimeError, match=r"zero or NaN|log_transition is -inf"):
            jax.jit(call)(jnp.array([0.5, 0.6, 0.4, 0.8]))

    @pytest.mark.parametrize(
        ("options", "named"),
        [
            ({"key": 0}, "key"),
            ({"filter": None}, "filter: None"),
            ({"trajectory": np.zeros(3)}, r"trajectory: float32\[3\] is not float32\[4\]"),
            ({"trajectory": {"x": np.zeros(4)}}, "trajectory: .*structure"),
            ({"trajectory": None}, "trajectory: None"),
            ({"trajectory": "abcd"}, "trajectory: .*abcd"),
            ({"trajectory": np.zeros(4, complex)}, "trajectory: complex128 is complex"),
            ({"backward": 1}, "backward: 1"),
            ({"observations": np.full(3, np.nan)}, "observations: NaN"),
        ],
    )
    def test_is_named(self, options, named):
        arguments = {
            "key": jax.random.key(0), "filter": mpfjax.particle_filter(Walled(), 6),
            "observations": ONES, "trajectory": np.full(4, 0.5),
        }  # fmt: skip
        with pytest.raises(ValueError, match=named):
            conditional_filter(**arguments | options)

    @pytest.mark.parametrize(
        ("make", "named"),
        [
            (lambda: mpfjax.particle_filter(NoTransition(), 6), "defines no log_transition"),
            (
                lambda: Filter(LINEAR, [Resample(), Propagate(LINEAR, noise="rqmc")], 6),
                "filter: .*independent of each other, and not noise='rqmc'",
            ),
            (
                lambda: mpfjax.particle_filter(LINEAR, 6, proposal=WithoutDensity()),
                "proposal: WithoutDensity defines no log_density",
            ),
            (
                lambda: Filter(Walled(), [Reweight(Walled())], 6),
                "filter: .*one Propagate or Predict",
            ),
            (
                lambda: mpfjax.partitioned_sampling(mpfjax.MultiObjectModel(Walled(), 2), 6),
                "filter: Partitioned cannot keep a trajectory",
            ),
            (
                lambda: mpfjax.gaussian_particle_filter(Walled(), 6),
                "filter: GaussianRegeneration cannot keep a trajectory",
            ),
        ],
    )  # fmt: skip
    def test_a_filter_that_cannot_keep_one_is_named(self, make, named):
        with pytest.raises(ValueError, match=named):
            call(filter=make())


class WithoutDensity(mpfjax.AbstractProposal):
    def propose(self, key, observation, previous_states):
        return previous_states, jnp.zeros(previous_states.shape[0])


@pytest.mark.parametrize("name", ["Gauss-Newton", "network"])
def test_the_density_of_a_proposal_is_that_of_its_draws(name):
    model = mpfjax.LinearGaussianModel(
        A=[[1.0, 0.5], [0.0, 0.8]], Q=[[0.2, 0.05], [0.05, 0.3]], H=[[1.0, 0.0]], R=[[0.5]],
        m0=[0.0, 0.3], P0=[[1.0, 0.2], [0.2, 0.5]],
    )  # fmt: skip
    proposal = {
        "Gauss-Newton": mpfjax.GaussNewtonProposal(model),
        "network": mpfjax.NetworkProposal.create(jax.random.key(2), 2, 1, 0.3),
    }[name]
    seen = jnp.array([0.7])

    @jax.jit
    def both(previous):
        states, log_density = proposal.propose(jax.random.key(1), seen, previous)
        return log_density, proposal.log_density(seen, states, previous)

    log_density, found = both(jax.random.normal(jax.random.key(0), (7, 2)))
    np.testing.assert_allclose(found, log_density, rtol=1e-4, atol=1e-4)
