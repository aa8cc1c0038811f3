"""Rao-Blackwellised propagation against enumeration, Kalman filters and numpy."""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax import (
    Filter,
    GroupBy,
    KMeans,
    PropagateMarginalised,
    PropagateNested,
    PropagateRegimes,
    RegimeProposal,
    Resample,
)
from mpfjax.exact import kalman_filter, switching_filter
from mpfjax.moves.propagation.propagate import Predict, Reweight
from mpfjax.moves.propagation.regimes import children
from tests.marking import thorough
from tests.switching import (
    MODEL,
    NUM_REGIMES,
    OBSERVATIONS,
    TRANSITIONS,
    moments,
    regimes,
    truth,
)

NUM_RUNS, NUM_PARTICLES = 1000, 30
KEY = jax.random.key(0)


def by_regime(state):
    return state.latent


FILTERS = {
    "pf": lambda: mpfjax.particle_filter(MODEL, NUM_PARTICLES),
    "pf rqmc": lambda: mpfjax.particle_filter(MODEL, NUM_PARTICLES, noise="rqmc"),
    "mpf": lambda: mpfjax.mixture_particle_filter(MODEL, NUM_PARTICLES, 3, regroup_every=1),
    "fully adapted": lambda: mpfjax.auxiliary_particle_filter(
        MODEL, NUM_PARTICLES, RegimeProposal(MODEL)
    ),
    "optimal proposal, mpf rqmc": lambda: mpfjax.mixture_particle_filter(
        MODEL, NUM_PARTICLES, 3, proposal=RegimeProposal(MODEL), noise="rqmc"
    ),
    "all children": lambda: Filter(MODEL, [PropagateRegimes(MODEL)], NUM_PARTICLES),
    "all children, by regime": lambda: Filter(
        MODEL, [PropagateRegimes(MODEL, GroupBy(by_regime))], NUM_PARTICLES, NUM_REGIMES
    ),
    "all children, in components": lambda: Filter(
        MODEL,
        [PropagateRegimes(MODEL), KMeans(2)],
        NUM_PARTICLES,
        2,
        initial_moves=[KMeans(2, reseed=True)],
    ),
    "families": lambda: mpfjax.with_proposals_per_particle(
        mpfjax.particle_filter(MODEL, NUM_PARTICLES), 3
    ),
    "a component for each regime": lambda: Filter(
        MODEL,
        [Resample(), PropagateMarginalised(MODEL), GroupBy(by_regime)],
        NUM_PARTICLES,
        NUM_REGIMES,
        initial_moves=[GroupBy(by_regime)],
    ),
}
QUICK = ("a component for each regime",)


@cache
def runs(name):
    keys = jax.random.split(jax.random.key(1), NUM_RUNS)
    return jax.tree.map(
        np.asarray, mpfjax.monte_carlo(keys, FILTERS[name](), OBSERVATIONS, moments)
    )


@pytest.mark.parametrize(
    "name", [*QUICK, *thorough([name for name in FILTERS if name not in QUICK])]
)
def test_evidence_regimes_and_moments_are_unbiased(name):
    """E[Ẑ/Z] = 1 and E[Ẑ/Z φ̂] = E[φ | y] at every step, against all sequences of regimes."""
    run, exact = runs(name), truth()
    ratios = np.exp(np.cumsum(run.log_likelihood_increments, axis=1) - exact.log_evidence)
    assert_unbiased(ratios, 1.0)
    for found, expected in zip(run.collected, exact[1:], strict=True):
        own = ratios.reshape(*ratios.shape, *[1] * (found.ndim - 2))
        assert_unbiased(own * found, expected)


def assert_unbiased(estimates, expected):
    """The mean over runs is within 4 standard errors of what is expected, in every entry."""
    standard_error = estimates.std(axis=0) / np.sqrt(NUM_RUNS)
    assert (standard_error < 0.1).all()  # loose estimates would prove nothing
    z = (estimates.mean(axis=0) - expected) / standard_error
    assert np.abs(z).max() < 4, f"standard errors away: {z}"


@pytest.mark.thorough
def test_a_hundred_particles_know_the_regimes():
    keys = jax.random.split(jax.random.key(2), 300)
    run = mpfjax.monte_carlo(keys, mpfjax.particle_filter(MODEL, 100), OBSERVATIONS, regimes)
    error = np.asarray(run.collected) - truth().regimes
    assert np.sqrt((error**2).mean()) < 0.08


class OnePath(mpfjax.AbstractConditionallyLinearModel):
    """A latent that counts the steps, so that every particle is the Kalman filter itself."""

    linear: mpfjax.LinearGaussianModel

    def sample_initial(self, key, num_particles):
        return jnp.zeros(num_particles)

    def initial_moments(self, latent):
        return self.linear.m0, self.linear.P0

    def sample_transition(self, key, latent):
        return latent + 1

    def dynamics(self, latent, previous_latent):
        return self.linear.A, jnp.zeros(2), self.linear.Q

    def emission(self, latent):
        # One for each particle here, and shared above.
        n = len(latent)
        return jnp.broadcast_to(self.linear.H, (n, 2, 2)), jnp.zeros((n, 2)), self.linear.R


LINEAR = mpfjax.LinearGaussianModel(
    A=[[1.0, 0.5], [0.0, 0.8]], Q=[[0.2, 0.1], [0.1, 0.3]], H=[[1.0, 0.2], [0.3, 1.0]],
    R=[[0.5, 0.2], [0.2, 0.4]], m0=[0.3, -0.2], P0=[[1.0, 0.1], [0.1, 0.5]],
)  # fmt: skip
SERIES = jnp.array([[0.4, 1.0], [-0.3, 0.2], [1.3, 0.9], [0.7, -0.8]])
ONE = mpfjax.particle_filter(OnePath(LINEAR), 4)


def test_each_particle_is_a_kalman_filter():
    run = mpfjax.run_filter(KEY, ONE, SERIES, lambda mixture: mixture.particles)
    exact = kalman_filter(LINEAR, SERIES)
    latent, mean, covariance = run.collected
    np.testing.assert_array_equal(latent[:, 0], [1, 2, 3, 4])
    for i in range(4):
        np.testing.assert_allclose(mean[:, i], exact.means, atol=1e-5)
        np.testing.assert_allclose(covariance[:, i], exact.covariances, atol=1e-5)
    np.testing.assert_allclose(
        run.log_likelihood_increments, exact.log_likelihood_increments, atol=1e-5
    )


def test_an_entry_that_is_missing_is_left_out_and_a_step_without_any_is_predicted():
    gaps = SERIES.at[1, 0].set(jnp.nan).at[2].set(jnp.nan)
    regimes_alike = mpfjax.SwitchingLinearGaussianModel(
        np.ones((1, 1)), LINEAR.A, LINEAR.Q, LINEAR.H, LINEAR.R, LINEAR.m0, LINEAR.P0
    )
    exact = switching_filter(regimes_alike, gaps)
    for missing in ("error", "skip"):
        run = mpfjax.run_filter(KEY, ONE, gaps, lambda m: m.mean(), missing=missing)
        np.testing.assert_allclose(run.collected.mean, exact.means, atol=1e-5)
        np.testing.assert_allclose(run.collected.covariance, exact.covariances, atol=1e-5)
        np.testing.assert_allclose(
            run.log_likelihood_increments, exact.log_likelihood_increments, atol=1e-5
        )


def test_a_forecast_is_the_kalman_predictor():
    run = mpfjax.run_filter(KEY, ONE, SERIES, lambda mixture: None)
    ahead = mpfjax.forecast(jax.random.key(1), ONE, run.final, 2).mixtures.particles
    exact = kalman_filter(LINEAR, SERIES)
    mean, covariance = np.asarray(exact.means[-1]), np.asarray(exact.covariances[-1])
    for step in range(2):
        mean, covariance = LINEAR.A @ mean, LINEAR.A @ covariance @ LINEAR.A.T + LINEAR.Q
        np.testing.assert_allclose(ahead.mean[step, 0], mean, atol=1e-5)
        np.testing.assert_allclose(ahead.covariance[step, 0], covariance, atol=1e-5)


def test_moments_of_a_mixture_are_those_of_its_gaussians():
    filter = FILTERS["a component for each regime"]()
    mixture = mpfjax.run_filter(KEY, filter, OBSERVATIONS, lambda mixture: None).final
    state, weights = mixture.particles, np.asarray(mixture.weights, float)
    means, covariances = np.asarray(state.mean, float), np.asarray(state.covariance, float)

    def of(chosen):
        w = np.where(chosen, weights, 0)
        w = w / w.sum()
        mean = w @ means
        gaps = means - mean
        return mean, np.einsum("n,nde->de", w, covariances + gaps[:, :, None] * gaps[:, None, :])

    mean, covariance = of(np.ones(NUM_PARTICLES, bool))
    np.testing.assert_allclose(mixture.mean().mean, mean, atol=1e-5)
    np.testing.assert_allclose(mixture.mean().covariance, covariance, atol=1e-5)
    components, flattened = mixture.component_means(), mixture.component_covariances()
    for m in range(NUM_REGIMES):
        mean, covariance = of(np.asarray(mixture.component_indicators) == m)
        np.testing.assert_allclose(components.mean[m], mean, atol=1e-5)
        np.testing.assert_allclose(components.covariance[m], covariance, atol=1e-5)
        np.testing.assert_allclose(flattened[m][1:, 1:], covariance, atol=1e-5)
        np.testing.assert_allclose(flattened[m][0], 0, atol=1e-5)  # one regime: it has no variance


@pytest.mark.thorough
@pytest.mark.parametrize("centre", [0.0, 10.0, 100.0])
def test_ten_thousand_steps_in_float32_leave_covariances_positive_and_log_z_as_in_float64(centre):
    """Q of rank 2 in 4 dimensions, and R a millionth of the variance of what is seen.

    Far from zero log Z is off by what it costs to round the observations to float32, which no
    filter could undo.
    """
    matrix = 0.9 * np.eye(4) + 0.9 * np.eye(4, k=2)
    push = np.vstack([0.5 * np.eye(2), np.eye(2)])
    rest = np.array([centre, centre, 0.0, 0.0])
    parts = {
        "F": matrix, "Q": 1e-4 * push @ push.T, "H": np.eye(2, 4), "R": 1e-8 * np.eye(2),
        "m0": rest, "P0": np.eye(4), "b": rest - matrix @ rest,
    }  # fmt: skip
    rng, state, series = np.random.default_rng(0), rest, []
    for _ in range(10_000):
        state = matrix @ state + parts["b"] + 1e-2 * push @ rng.normal(size=2)
        series.append(state[:2] + 1e-4 * rng.normal(size=2))
    model = mpfjax.SwitchingLinearGaussianModel(np.ones((1, 1)), **parts)
    filter = mpfjax.particle_filter(model, 1)
    collect = lambda mixture: mixture.particles.covariance[0]  # noqa: E731
    run = mpfjax.run_filter(KEY, filter, jnp.asarray(series, jnp.float32), collect)
    assert run.collected.dtype == jnp.float32
    assert np.linalg.eigvalsh(np.asarray(run.collected, float)).min() > 0
    rounded = increments_of_numpy(parts, np.array(series, np.float32).astype(float))

    def gaps(increments):
        return np.asarray(increments - rounded, float).reshape(100, 100).sum(axis=1)

    own, of_rounding = gaps(run.log_likelihood_increments), gaps(increments_of_numpy(parts, series))
    if centre == 0:
        assert np.abs(own).max() < 0.01
    assert np.sqrt((own**2).mean()) < 1.5 * np.sqrt((of_rounding**2).mean()) + 1e-3


def increments_of_numpy(parts, series):
    """log p(y_t | y_1..y_{t-1}) in float64, with the parts rounded to float32."""
    parts = {name: np.asarray(value, np.float32).astype(float) for name, value in parts.items()}
    matrix, noise, seen = parts["F"], parts["Q"], parts["H"]
    mean, covariance, found = parts["m0"], parts["P0"], []
    for observation in series:
        mean, covariance = matrix @ mean + parts["b"], matrix @ covariance @ matrix.T + noise
        spread = seen @ covariance @ seen.T + parts["R"]
        gain, missed = np.linalg.solve(spread, seen @ covariance).T, observation - seen @ mean
        squares = missed @ np.linalg.solve(spread, missed)
        found.append(-0.5 * (squares + np.linalg.slogdet(2 * np.pi * spread)[1]))
        mean, left = mean + gain @ missed, np.eye(4) - gain @ seen
        covariance = left @ covariance @ left.T + gain @ parts["R"] @ gain.T
    return np.array(found)


class Wrong(OnePath):
    """One of its parts is not as it should be."""

    part: str = ""

    def initial_moments(self, latent):
        m0, P0 = super().initial_moments(latent)
        return (m0, P0[:1]) if self.part == "P0" else (m0, P0)

    def dynamics(self, latent, previous_latent):
        F, b, Q = super().dynamics(latent, previous_latent)
        return {"F": (F[0], b, Q), "b": (F, b[:1], Q), "Q": (F, b)}.get(self.part, (F, b, Q))

    def emission(self, latent):
        H, c, R = super().emission(latent)
        return (H[:, :1], c, R) if self.part == "R" else (H, c, R)


@pytest.mark.parametrize(
    ("part", "message"),
    [
        ("P0", "Wrong.initial_moments returned P0 of shape"),
        ("F", "Wrong.dynamics returned F of shape"),
        ("b", "Wrong.dynamics returned b of shape"),
        ("Q", "Wrong.dynamics returned .* not the arrays F, b, Q"),
        ("R", "Wrong.emission returned c of shape"),
    ],
)
def test_parts_of_other_shapes_are_named(part, message):
    with pytest.raises(ValueError, match=message):
        mpfjax.run_filter(KEY, mpfjax.particle_filter(Wrong(LINEAR, part), 4), SERIES)


def test_the_marginalised_step_is_that_of_the_same_moves():
    ratios = []
    for moves in (
        [Resample(), PropagateMarginalised(MODEL)],
        [Resample(), mpfjax.Propagate(MODEL)],
        [Resample(), Predict(MODEL), Reweight(MODEL)],
    ):
        run = mpfjax.run_filter(KEY, Filter(MODEL, moves, 2000), OBSERVATIONS)
        ratios.append(float(run.log_marginal_likelihood) - truth().log_evidence[-1])
    assert ratios[0] == ratios[1]
    np.testing.assert_allclose(ratios, 0.0, atol=0.1)


def test_misuse_is_named():
    with pytest.raises(ValueError, match="observation: shape"):
        mpfjax.run_filter(KEY, ONE, SERIES[:, :1])
    for make in (mpfjax.PropagateTempered, lambda model: Reweight(model, 0.5)):
        with pytest.raises(ValueError, match=r"model: .* is conditionally linear"):
            make(MODEL)
    with pytest.raises(ValueError, match=r"object_model: .* is conditionally linear"):
        mpfjax.MultiObjectModel(MODEL, 2)
    with pytest.raises(ValueError, match=r"model: .* conditionally linear"):
        mpfjax.gaussian_particle_filter(MODEL, 10)
    with pytest.raises((ValueError, TypeError), match="AbstractConditionallyLinearModel"):
        PropagateMarginalised(LINEAR)
    with pytest.raises(ValueError, match="log_transition"):
        PropagateMarginalised(OnePath(LINEAR), gradient="stop")
    with pytest.raises(ValueError, match="transition_from_noise"):
        PropagateMarginalised(OnePath(LINEAR), noise="rqmc")
    with pytest.raises(ValueError, match="propagate:"):
        PropagateNested(PropagateMarginalised(MODEL, gradient="stop"))


def test_with_the_optimal_proposal_all_weights_are_equal():
    filter = mpfjax.auxiliary_particle_filter(MODEL, NUM_PARTICLES, RegimeProposal(MODEL))
    run = mpfjax.run_filter(KEY, filter, OBSERVATIONS, lambda mixture: mixture.log_weights)
    np.testing.assert_allclose(run.collected, -np.log(NUM_PARTICLES), atol=1e-4)


def test_optimal_resampling_keeps_heavy_children_and_none_twice():
    filter = Filter(MODEL, [PropagateRegimes(MODEL)], NUM_PARTICLES)
    start = mpfjax.run_filter(KEY, filter, OBSERVATIONS[:4], lambda mixture: None).final
    step = jax.jit(jax.vmap(lambda key: filter.step(key, start, OBSERVATIONS[4])[0]))
    after = jax.tree.map(np.asarray, step(jax.random.split(KEY, 2000)))
    child = after.ancestor_indices * NUM_REGIMES + after.particles.latent
    assert all(len(set(row)) == NUM_PARTICLES for row in child)
    # The children's own weights, and the threshold by trying all numbers of heavy ones.
    _, _, log_factors = children(MODEL, OBSERVATIONS[4], start.particles)
    weights = np.exp(np.asarray(start.log_weights[None] + log_factors, float)).T.ravel()
    weights /= weights.sum()
    falling = np.sort(weights)[::-1]
    for num_heavy in range(NUM_PARTICLES):
        threshold = falling[num_heavy:].sum() / (NUM_PARTICLES - num_heavy)
        if falling[num_heavy] < threshold:
            break
    kept = np.zeros((2000, len(weights)))
    np.put_along_axis(kept, child, np.exp(after.log_weights), axis=1)
    heavy = weights >= threshold
    assert 0 < heavy.sum() < NUM_PARTICLES
    np.testing.assert_allclose(kept[:, heavy], np.tile(weights[heavy], (2000, 1)), rtol=1e-3)
    light = kept[:, ~heavy]
    np.testing.assert_allclose(light[light > 0], threshold, rtol=1e-3)
    error = 4.5 * light.std(axis=0) / np.sqrt(2000) + 4 * threshold / 2000
    assert (np.abs(light.mean(axis=0) - weights[~heavy]) <= error).all()


@pytest.mark.parametrize("name", ["all children, by regime", "all children, in components"])
def test_no_child_is_kept_twice_and_every_component_keeps_its_mass(name):
    """Wherever the children stand, and whether y is there or not."""
    filter = FILTERS[name]()
    start = mpfjax.run_filter(KEY, filter, OBSERVATIONS[:3], lambda mixture: None).final
    move, keys = filter.moves[0], jax.random.split(KEY, 200)
    own = start.replace(ancestor_indices=jnp.arange(NUM_PARTICLES, dtype=jnp.int32))
    seen = jax.jit(jax.vmap(lambda key: move(key, own, OBSERVATIONS[3])))(keys)
    unseen = jax.jit(jax.vmap(lambda key: move.predict(key, own)))(keys)
    for after in jax.tree.map(np.asarray, (seen, unseen)):
        child = after.ancestor_indices * NUM_REGIMES + after.particles.latent
        filled = after.log_weights > -np.inf
        assert all(len(set(c[f])) == f.sum() for c, f in zip(child, filled, strict=True))
        labels = after.component_indicators[:, :, None] == np.arange(start.num_components)
        masses = (np.exp(after.log_weights)[:, :, None] * labels).sum(axis=1)
        np.testing.assert_allclose(masses, np.tile(masses[:1], (len(keys), 1)), rtol=1e-4)
    np.testing.assert_allclose(masses.sum(axis=1), 1, rtol=1e-4)


@pytest.mark.thorough
def test_regimes_have_their_share_without_components_too():
    """Children of a regime stand side by side: in turn, Ẑ would have three times the deviation."""
    one, many = (
        np.exp(runs(name).log_marginal_likelihood - truth().log_evidence[-1]).std()
        for name in ("all children", "all children, by regime")
    )
    assert one < 1.5 * many


def test_more_slots_than_children_stay_empty():
    """Copies would have the moments that they copy: with every child, the filter is exact."""
    filter = Filter(MODEL, [PropagateRegimes(MODEL)], NUM_REGIMES**4)
    every = filter.init(KEY)
    one = every.particles._replace(latent=jnp.zeros_like(every.particles.latent))
    first = jnp.arange(filter.num_particles) == 0
    start = every.replace(particles=one, log_weights=jnp.where(first, 0.0, -jnp.inf))
    probabilities = jnp.asarray([1.0, 0, 0])
    known = eqx.tree_at(lambda model: model.initial_probabilities, MODEL, probabilities)
    exact = switching_filter(known, OBSERVATIONS[:4])
    keys = jax.random.split(KEY, 4)
    for step, key in enumerate(keys):
        start, info = filter.step(key, start, OBSERVATIONS[step])
        assert int(start.occupied.sum()) == NUM_REGIMES ** (step + 1)
        np.testing.assert_allclose(
            info.log_likelihood_increment, exact.log_likelihood_increments[step], rtol=1e-4
        )


def test_regimes_need_a_model_that_lists_them():
    for make in (RegimeProposal, PropagateRegimes):
        with pytest.raises(ValueError, match="all_transitions"):
            make(OnePath(LINEAR))


def test_a_forecast_of_all_children_moves_regimes_by_their_matrix():
    filter = Filter(MODEL, [PropagateRegimes(MODEL)], 3000)
    start = mpfjax.run_filter(KEY, filter, OBSERVATIONS[:3], lambda mixture: None).final
    ahead, info = filter.predict(jax.random.key(5), start)
    assert float(info.log_likelihood_increment) == 0
    np.testing.assert_allclose(float(ahead.log_mass), 0, atol=1e-4)
    np.testing.assert_allclose(regimes(ahead), regimes(start) @ TRANSITIONS, atol=0.01)


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["stop", "stop, optimal proposal", "all children"])
def test_derivatives_of_the_evidence_are_unbiased(kind):
    """E[∇Ẑ] = ∇Z, for a parameter of the law of z and one of the noise of x."""

    def model_of(parameters):
        stays, scale = parameters
        matrix = TRANSITIONS + stays * jnp.array([[1.0, -1, 0], [0, 1, -1], [-1, 0, 1]])
        return eqx.tree_at(lambda m: (m.transition_matrix, m.Q), MODEL, (matrix, scale * MODEL.Q))

    def run_of(parameters, key):
        model = model_of(parameters)
        if kind == "all children":
            filter = Filter(model, [PropagateRegimes(model)], 10)
        else:
            proposal = RegimeProposal(model) if "proposal" in kind else None
            filter = mpfjax.particle_filter(model, 10, proposal=proposal, gradient="stop")
        run = mpfjax.run_filter(key, filter, OBSERVATIONS[:4], lambda mixture: None)
        return run.log_marginal_likelihood

    at = (jnp.array(0.0), jnp.array(1.0))
    exact, slope = jax.value_and_grad(
        lambda p: switching_filter(model_of(p), OBSERVATIONS[:4]).log_marginal_likelihood
    )(at)
    keys = jax.random.split(jax.random.key(3), 4000)
    logs, slopes = jax.jit(jax.vmap(jax.value_and_grad(run_of), (None, 0)))(at, keys)
    ratios = np.exp(np.asarray(logs - exact))
    for found, expected in zip(slopes, slope, strict=True):
        values = ratios * np.asarray(found)
        error = values.std() / np.sqrt(len(keys))
        assert error < 0.3 * abs(float(expected))
        assert abs(values.mean() - float(expected)) < 4 * error


class Wandering(mpfjax.AbstractConditionallyLinearModel):
    """The latent moves by x and shifts what is seen; matrices are shared, or one a particle."""

    repeated: bool = eqx.field(static=True)

    def sample_initial(self, key, num_particles):
        return jax.random.normal(key, (num_particles, 1))

    def initial_moments(self, latent):
        return LINEAR.m0, LINEAR.P0

    def latent_dynamics(self, previous_latent):
        return previous_latent, jnp.array([[0.3, 0.1]]), jnp.array([[0.2]])

    def dynamics(self, latent, previous_latent):
        A = jnp.broadcast_to(LINEAR.A, (len(latent), 2, 2)) if self.repeated else LINEAR.A
        return A, jnp.repeat(0.1 * previous_latent, 2, axis=1), LINEAR.Q

    def emission(self, latent):
        return LINEAR.H, jnp.repeat(jnp.sin(latent), 2, axis=1), LINEAR.R


def test_a_covariance_that_all_share_is_that_of_each():
    """Computed once or for each particle, also where an entry or an observation is missing."""
    series = SERIES.at[1].set(jnp.nan).at[2, 0].set(jnp.nan)

    def collected(mixture):
        return mixture.particles.mean, mixture.particles.covariance

    runs = [
        mpfjax.run_filter(
            KEY, mpfjax.particle_filter(Wandering(repeated), 20), series, collected, missing="skip"
        )
        for repeated in (False, True)
    ]
    np.testing.assert_allclose(
        runs[0].log_marginal_likelihood, runs[1].log_marginal_likelihood, rtol=1e-5
    )
    for shared, own in zip(*(run.collected for run in runs), strict=True):
        np.testing.assert_allclose(shared, own, rtol=1e-4, atol=1e-5)
    assert np.ptp(np.asarray(runs[0].collected[1]), axis=1).max() == 0


class Pushed(OnePath):
    """A push that is known moves x."""

    inputs: jax.Array | None = None

    def dynamics(self, latent, previous_latent):
        return self.linear.A, self.inputs, self.linear.Q


def test_inputs_reach_the_dynamics():
    pushes = jnp.array([[0.5, 0.0], [0.0, -1.0], [0.3, 0.2], [0.0, 0.0]])
    filter = mpfjax.particle_filter(Pushed(LINEAR), 4)
    run = mpfjax.run_filter(KEY, filter, SERIES, lambda m: m.mean().mean, inputs=pushes)
    # The pushes' own path is taken off what is observed, and put back on what is found.
    offsets, offset = [], np.zeros(2)
    for push in np.asarray(pushes):
        offset = np.asarray(LINEAR.A) @ offset + push
        offsets.append(offset)
    offsets = np.array(offsets, np.float32)
    exact = kalman_filter(LINEAR, SERIES - offsets @ np.asarray(LINEAR.H).T)
    np.testing.assert_allclose(run.collected, exact.means + offsets, atol=1e-5)
    np.testing.assert_allclose(
        run.log_marginal_likelihood, exact.log_marginal_likelihood, rtol=1e-5
    )
