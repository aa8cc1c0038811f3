"""Known inputs: controls and times that the model finds in its field `inputs` at each step.

The driven Ornstein-Uhlenbeck process dx = k (g u - x) dt + s dW, seen at irregular times, is linear
and Gaussian: numpy has the exact answer, without any recursion.
"""

from functools import cache
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy.stats import norm

import mpfjax
from mpfjax.exact import grid_filter, kalman_filter, kalman_smoother
from mpfjax.moves.propagation.propagate import Predict, Reweight
from mpfjax.smoothing import sample_trajectories, smoothed_sums
from tests.marking import thorough

TIMES = np.cumsum([0.3, 1.7, 0.2, 0.2, 2.5, 0.6]).astype(np.float32)
INPUTS = {
    "dt": np.diff(TIMES, prepend=np.float32(0)),
    "u": np.array([1.0, 1.0, -1.0, 0.5, 2.0, -2.0], np.float32),
}
OBSERVATIONS = jnp.array([0.6, 1.1, 0.1, -0.2, 2.3, 0.2])
LENGTH = len(TIMES)
RATE, GAIN, SPREAD, ERROR = 0.8, 1.2, 0.7, 0.4
TRACED = []  # how often JAX has traced the likelihood


def array(default: float) -> Any:
    return eqx.field(converter=lambda value: jnp.asarray(value, float), default=default)


class Driven(mpfjax.AbstractStateSpaceModel):
    """The process, with its exact transition over the time since the last step."""

    rate: jax.Array = array(RATE)
    gain: jax.Array = array(GAIN)
    inputs: Any = None

    noise_dimension = 1
    observation_covariance = property(lambda self: jnp.asarray(ERROR**2))

    def sample_initial(self, key, num_particles):
        return jax.random.normal(key, (num_particles,))

    def log_initial(self, states):
        return norm.logpdf(states)

    def transition_from_noise(self, noise, states):
        return self.transition_mean(states) + jnp.sqrt(self.transition_covariance) * noise[:, 0]

    def log_transition(self, states, previous_states):
        deviation = jnp.sqrt(self.transition_covariance)
        return norm.logpdf(states, self.transition_mean(previous_states), deviation)

    def log_likelihood(self, observation, states):
        TRACED.append(None)
        return norm.logpdf(observation, states, ERROR)

    def transition_mean(self, states):
        kept = jnp.exp(-self.rate * self.inputs["dt"])
        return kept * states + (1 - kept) * self.gain * self.inputs["u"]

    @property
    def transition_covariance(self):
        kept = jnp.exp(-self.rate * self.inputs["dt"])
        return SPREAD**2 / (2 * self.rate) * (1 - kept**2)

    def observation_mean(self, states):
        return states


class DrivenOfOne:
    """The same for one particle, by random walks; not even a module."""

    inputs: Any = None

    def sample_initial(self, key):
        return jax.random.normal(key)

    def sample_transition(self, key, state):
        (state,) = Driven(inputs=self.inputs).sample_transition(key, state[None])
        return state

    def log_likelihood(self, observation, state):
        return norm.logpdf(observation, state, ERROR)


def in_matrices(gain=GAIN):
    """The same as a linear-Gaussian model, whose matrices are inputs."""
    eye = np.eye(1, dtype=np.float32)
    model = mpfjax.LinearGaussianModel(eye, eye, eye, ERROR**2 * eye, np.zeros(1), eye, B=eye)
    kept = jnp.exp(-RATE * INPUTS["dt"])[:, None, None]
    inputs = {
        "A": kept,
        "Q": SPREAD**2 / (2 * RATE) * (1 - kept**2),
        "B": (1 - kept) * gain,
        "inputs": jnp.asarray(INPUTS["u"])[:, None],
    }
    return model, inputs


@cache
def truth():
    """log Z, and E[x_t | y_1..y_t] and E[x_t | y] of all times, from the joint normal law."""
    kept = np.exp(-RATE * INPUTS["dt"].astype(float))
    mean, covariance = np.zeros(LENGTH + 1), np.zeros((LENGTH + 1, LENGTH + 1))
    covariance[0, 0] = 1.0
    for t, a in enumerate(kept, 1):
        mean[t] = a * mean[t - 1] + (1 - a) * GAIN * INPUTS["u"][t - 1]
        covariance[t, :t] = covariance[:t, t] = a * covariance[t - 1, :t]
        covariance[t, t] = a**2 * covariance[t - 1, t - 1] + SPREAD**2 / (2 * RATE) * (1 - a**2)

    def given(num_seen):
        seen = slice(1, num_seen + 1)
        of_seen = covariance[seen, seen] + ERROR**2 * np.eye(num_seen)
        residual = OBSERVATIONS[:num_seen] - mean[seen]
        log_z = -0.5 * residual @ np.linalg.solve(of_seen, residual)
        log_z -= 0.5 * np.linalg.slogdet(2 * np.pi * of_seen)[1]
        return log_z, mean + covariance[:, seen] @ np.linalg.solve(of_seen, residual)

    steps = [given(s) for s in range(1, LENGTH + 1)]
    filtered = [smoothed[s] for s, (_, smoothed) in enumerate(steps, 1)]
    return steps[-1][0], np.array(filtered), steps[-1][1]


def mean(mixture):
    return mixture.mean()


def nothing(mixture):
    return None


class TestReferences:
    def test_kalman_filter_with_controls_and_matrices_by_time(self):
        model, inputs = in_matrices()
        run = kalman_filter(model, mpfjax.Series(OBSERVATIONS[:, None], inputs))
        log_z, filtered, _ = truth()
        np.testing.assert_allclose(run.log_marginal_likelihood, log_z, atol=1e-5)
        np.testing.assert_allclose(run.means[:, 0], filtered, atol=1e-5)

    def test_kalman_smoother_with_controls_and_matrices_by_time(self):
        model, inputs = in_matrices()
        run = kalman_smoother(model, mpfjax.Series(OBSERVATIONS[:, None], inputs))
        np.testing.assert_allclose(run.means[:, 0], truth()[2], atol=1e-5)

    def test_grid_filter(self):
        grid = jnp.linspace(-4.0, 5.0, 700)
        run = grid_filter(Driven(), mpfjax.Series(OBSERVATIONS, INPUTS), grid)
        log_z, filtered, _ = truth()
        np.testing.assert_allclose(run.log_marginal_likelihood, log_z, atol=1e-4)
        np.testing.assert_allclose(run.means, filtered, atol=1e-4)


NUM_RUNS = 2000
FILTERS = {
    "pf": lambda: mpfjax.particle_filter(Driven(), 48),
    "mpf": lambda: mpfjax.mixture_particle_filter(Driven(), 48, 3),
}


@pytest.mark.parametrize("name", ["mpf", *thorough(["pf"])])
def test_evidence_and_means_are_unbiased(name):
    """E[Ẑ/Z] = 1 and E[Ẑ/Z E^[x_t]] = E[x_t | y_1..y_t], within 4 standard errors."""
    keys = jax.random.split(jax.random.key(3), NUM_RUNS)
    run = mpfjax.monte_carlo(keys, FILTERS[name](), OBSERVATIONS, mean, inputs=INPUTS)
    log_z, filtered, _ = truth()
    ratios = np.exp(np.asarray(run.log_marginal_likelihood) - log_z)
    assert ratios.std() / np.sqrt(NUM_RUNS) < 0.04
    for estimates, expected in ((ratios, 1.0), (ratios * run.collected[:, -1], filtered[-1])):
        standard_error = np.std(estimates) / np.sqrt(NUM_RUNS)
        assert abs(np.mean(estimates) - expected) < 4 * standard_error


@pytest.mark.parametrize(
    "method", thorough(["trajectories", "trajectories by mcmc", "sums", "sums by mcmc"])
)
def test_smoothed_means_are_those_of_the_kalman_smoother(method):
    """Of every time, within 4 standard errors over the runs."""
    model, inputs = in_matrices()
    expected = kalman_smoother(model, mpfjax.Series(OBSERVATIONS[:, None], inputs)).means[:, 0]
    filter, name = mpfjax.particle_filter(Driven(), 300), "exact"
    given = jax.tree.map(jnp.asarray, INPUTS)
    if method.endswith("mcmc"):
        name = "mcmc"

    def by_trajectories(key):
        of_run, of_paths = jax.random.split(key)
        run = mpfjax.run_filter(of_run, filter, OBSERVATIONS, inputs=given)
        options = {} if name == "exact" else {"num_steps": 30}
        paths = sample_trajectories(
            of_paths, filter.model, run, 300, method=name, inputs=given, **options
        )
        return paths.mean(axis=0)

    def by_sums(key):
        # With a lag of the whole series, each term is smoothed by all observations.
        found = smoothed_sums(
            key, filter, mpfjax.Series(OBSERVATIONS, given),
            lambda before, after: jnp.stack([before, after], axis=1),
            lag=LENGTH, method=name, num_draws=2 if name == "exact" else 30,
        )  # fmt: skip
        return jnp.concatenate([found.terms[:1, 0], found.terms[:, 1]])

    one = by_sums if method.startswith("sums") else by_trajectories
    keys = jax.random.split(jax.random.key(8), 120)
    means = np.asarray(jax.lax.map(one, keys))
    errors = means.std(axis=0) / np.sqrt(len(keys))
    assert (errors < 0.01).all()
    assert (np.abs(means.mean(axis=0) - np.asarray(expected)) < 4 * errors).all()


def built_in(dt=0.5, u=1.0):
    """What every step sees where the inputs are constant."""
    return {"dt": jnp.asarray(dt), "u": jnp.asarray(u)}


def repeated(inputs):
    return jax.tree.map(lambda leaf: jnp.repeat(leaf[None], LENGTH, axis=0), inputs)


def look_ahead(model):
    """A method of the model, which a move holds with the model in it."""
    return eqx.Partial(lambda model, y, x: model.log_likelihood(y, model.transition_mean(x)), model)


def of_objects(make, **options):
    def filter(inputs):
        model = Driven(inputs=inputs)
        joint = mpfjax.MultiObjectModel(model, 2, shared_observation=True, **options)
        return make(joint)

    return filter


def own_chain(*moves):
    def filter(inputs):
        model = Driven(inputs=inputs)
        return mpfjax.Filter(model, [mpfjax.Resample(), *[move(model) for move in moves]], 32)

    return filter


EVERYWHERE = {
    "guided mpf rqmc": lambda inputs: mpfjax.mixture_particle_filter(
        (model := Driven(inputs=inputs)), 32, 2, noise="rqmc",
        proposal=mpfjax.GaussNewtonProposal(model),
    ),
    "look-ahead": lambda inputs: mpfjax.auxiliary_particle_filter(
        (model := Driven(inputs=inputs)), 32, look_ahead(model)
    ),
    "families": own_chain(lambda model: mpfjax.PropagateNested(mpfjax.Propagate(model), 2)),
    "stages": own_chain(lambda model: mpfjax.PropagateTempered(model)),
    "predict and weigh": own_chain(Predict, Reweight),
    "a proposal with a model of its own": own_chain(
        lambda model: mpfjax.Propagate(
            model, mpfjax.GaussNewtonProposal(Driven(jnp.array(0.5), inputs=model.inputs))
        )
    ),
    "ps": of_objects(lambda joint: mpfjax.partitioned_sampling(joint, 32)),
    "dps": of_objects(lambda joint: mpfjax.distributed_partitioned_sampling(joint, 32)),
    "independent": of_objects(lambda joint: mpfjax.independent_particle_filters(joint, 32)),
    "clusters": of_objects(
        lambda joint: mpfjax.clustered_particle_filter(joint, 32, start="together")
    ),
}  # fmt: skip
QUICK = ("guided mpf rqmc",)


@pytest.mark.parametrize(
    "name", [*QUICK, *thorough(name for name in EVERYWHERE if name not in QUICK)]
)
def test_every_move_sees_the_inputs(name):
    """Inputs that are constant give the run of the model with the constants built in."""
    key, make = jax.random.key(0), EVERYWHERE[name]
    expected = mpfjax.run_filter(key, make(built_in()), OBSERVATIONS, mean)
    run = mpfjax.run_filter(key, make(None), OBSERVATIONS, mean, inputs=repeated(built_in()))
    np.testing.assert_allclose(run.collected, expected.collected, rtol=1e-5, atol=1e-6)
    others = repeated(built_in(u=2.0))
    other = mpfjax.run_filter(key, make(None), OBSERVATIONS, mean, inputs=others)
    assert np.abs(other.collected - run.collected).min() > 1e-3


class Drawn(mpfjax.AbstractStateSpaceModel):
    """x_t = u_t + noise, seen exactly enough; any object may have its own shift."""

    shift: jax.Array
    inputs: Any = None

    def sample_initial(self, key, num_particles):
        return self.shift + jax.random.normal(key, (num_particles,))

    def sample_transition(self, key, states):
        return self.shift + self.inputs + 0.01 * jax.random.normal(key, states.shape)

    def log_likelihood(self, observation, states):
        return norm.logpdf(observation, states - self.inputs, 1.0)


@pytest.mark.parametrize(
    ("per_object", "shared"), [(True, False), *thorough([(True, True), (False, False)])]
)
def test_objects_have_one_input_or_their_own(per_object, shared):
    shift = jnp.array([1.0, 2.0, 3.0]) if per_object else jnp.array(1.0)
    model = mpfjax.MultiObjectModel(
        Drawn(shift), 3, shared_observation=True, per_object=per_object, shared_inputs=shared
    )
    filter = mpfjax.partitioned_sampling(model, 16)
    own = jnp.array([10.0]) if shared else jnp.array([10.0, 20.0, 30.0])
    inputs = own if shared else own[None]
    run = mpfjax.run_filter(jax.random.key(0), filter, jnp.ones(1), mean, inputs=inputs)
    np.testing.assert_allclose(run.collected[0], jnp.broadcast_to(shift + own, (3,)), atol=0.02)


def test_an_input_without_an_axis_of_objects_is_an_error():
    model = mpfjax.MultiObjectModel(Drawn(jnp.array(1.0)), 3, shared_inputs=False)
    filter = mpfjax.partitioned_sampling(model, 4)
    with pytest.raises(ValueError, match=r"inputs: shape \(\) has no leading axis of num_objects"):
        mpfjax.run_filter(jax.random.key(0), filter, jnp.ones((2, 3)), inputs=jnp.ones(2))


class TestRunners:
    """One plain filter, in every way that it can be run."""

    FILTER = mpfjax.particle_filter(Driven(), 32)
    KEY = jax.random.key(0)

    def run(self, **options):
        options = {"observations": OBSERVATIONS, "collect": mean, "inputs": INPUTS} | options
        return mpfjax.run_filter(self.KEY, options.pop("filter", self.FILTER), **options)

    def test_steps_equal_the_scan(self):
        expected = self.run()
        key_initial, key_steps = jax.random.split(self.KEY)
        mixture = self.FILTER.init(key_initial)
        for t, key in enumerate(jax.random.split(key_steps, LENGTH)):
            now = jax.tree.map(lambda leaf, t=t: leaf[t], INPUTS)
            mixture, info = self.FILTER.step(key, mixture, OBSERVATIONS[t], inputs=now)
            np.testing.assert_allclose(
                info.log_likelihood_increment, expected.log_likelihood_increments[t], rtol=1e-4
            )
        np.testing.assert_allclose(mixture.mean(), expected.collected[-1], rtol=1e-4)

    def test_a_missing_observation_does_not_miss_its_input(self):
        seen = np.array(OBSERVATIONS)
        seen[-1] = np.nan
        run = self.run(observations=seen, missing="skip", collect=None)
        before = jax.tree.map(lambda leaf: leaf[-2], run.collected)
        last = jax.tree.map(lambda leaf: leaf[-1], INPUTS)
        key = jax.random.split(jax.random.split(self.KEY)[1], LENGTH)[-1]
        predicted, _ = self.FILTER.predict(key, before, inputs=last)
        np.testing.assert_allclose(predicted.mean(), run.final.mean(), rtol=1e-4)
        ahead = jax.tree.map(lambda leaf: leaf[None], last)
        forecast = mpfjax.forecast(key, self.FILTER, before, 1, inputs=ahead)
        kept = np.exp(-RATE * last["dt"])
        expected = kept * before.mean() + (1 - kept) * GAIN * last["u"]
        np.testing.assert_allclose(forecast.mixtures.particles.mean(), expected, atol=0.3)

    def test_monte_carlo_islands_and_studies(self, tmp_path):
        expected = self.run().log_marginal_likelihood
        runs = mpfjax.monte_carlo(self.KEY[None], self.FILTER, OBSERVATIONS, nothing, inputs=INPUTS)
        np.testing.assert_allclose(runs.log_marginal_likelihood[0], expected, rtol=1e-5)
        study = mpfjax.Study(
            {"pf": lambda num_particles: mpfjax.particle_filter(Driven(), num_particles)},
            [32], self.KEY[None], mpfjax.Series(OBSERVATIONS, INPUTS),
        )  # fmt: skip
        (cell,) = mpfjax.run_study(study, tmp_path)
        np.testing.assert_allclose(cell["log_marginal_likelihood"][0], expected, rtol=1e-5)
        other = mpfjax.Study(
            study.filters,
            [32],
            self.KEY[None],
            mpfjax.Series(OBSERVATIONS, repeated(built_in())),
        )
        with pytest.raises(ValueError, match=r"holds another study \(observations"):
            mpfjax.run_study(other, tmp_path, resume=True)
        island = mpfjax.run_islands(
            self.KEY, self.FILTER, mpfjax.Series(OBSERVATIONS, INPUTS), nothing, num_islands=1
        )
        alone = mpfjax.run_filter(
            jax.random.fold_in(self.KEY, 0), self.FILTER, OBSERVATIONS, nothing, inputs=INPUTS
        )
        np.testing.assert_allclose(
            island.log_marginal_likelihood, alone.log_marginal_likelihood, rtol=1e-5
        )

    def test_a_model_of_one_particle(self):
        filter = mpfjax.particle_filter(mpfjax.per_particle(DrivenOfOne()), 2000)
        run = self.run(filter=filter)
        np.testing.assert_allclose(run.collected, truth()[1], atol=0.1)

    def test_nothing_compiles_again(self):
        self.run()
        before = len(TRACED)
        self.run(inputs=jax.tree.map(lambda leaf: 0.5 * leaf, INPUTS))
        assert len(TRACED) == before > 0

    @pytest.mark.parametrize(
        ("inputs", "message"),
        [
            ({"dt": np.ones(5), "u": np.ones(5)}, "inputs: the leading axis t is 5, and that of"),
            ({"dt": np.ones(6), "u": np.ones(5)}, "inputs: shapes .* do not share"),
            ({"dt": np.ones(6), "u": 1.0}, "inputs: shapes .* do not share"),
            ({}, "inputs: there are none"),
            (np.array(["a"] * 6), "inputs: .* no array of numbers"),
            ({"dt": np.array([1, 1, np.nan, 1, 1, 1])}, "inputs: NaN or infinite at index 2"),
            ({"dt": np.array([1, 1, 1e60, 1, 1, 1])}, "inputs: 1e[+]60 is more than"),
        ],
    )
    def test_bad_inputs_are_named(self, inputs, message):
        with pytest.raises(ValueError, match=message):
            self.run(inputs=inputs)

    def test_an_input_of_a_step_must_be_finite(self):
        mixture = self.FILTER.init(self.KEY)
        with pytest.raises(RuntimeError, match="inputs: NaN or infinite"):
            self.FILTER.step(self.KEY, mixture, OBSERVATIONS[0], inputs=built_in(u=np.nan))

    @pytest.mark.parametrize(
        "model", [Driven(), *thorough([mpfjax.per_particle(DrivenOfOne())])], ids=["all", "one"]
    )
    def test_an_error_where_none_were_given_says_so(self, model):
        """The model fails on None, by whatever error; models that do without are not refused."""
        filter = mpfjax.particle_filter(model, 32)
        mixture = filter.init(self.KEY)
        for run in (
            lambda: self.run(filter=filter, inputs=None),
            lambda: filter.step(self.KEY, mixture, OBSERVATIONS[0]),
            lambda: mpfjax.forecast(self.KEY, filter, mixture, 2),
        ):
            with pytest.raises(TypeError) as caught:
                run()
            (note,) = [note for note in caught.value.__notes__ if "inputs" in note]
            assert "inputs: there are none, so Driven" in note
        if isinstance(model, Driven):
            past = self.run(collect=None)
            with pytest.raises(TypeError) as caught:
                sample_trajectories(self.KEY, model, past, 5)
            assert "inputs: there are none" in caught.value.__notes__[-1]

    def test_a_model_without_a_place_is_named(self):
        filter = mpfjax.particle_filter(mpfjax.QuadraticModel(0.3, 0.5, -2.0, 2.0), 4)
        with pytest.raises(ValueError, match="inputs: QuadraticModel has no place for them"):
            self.run(filter=filter)


def test_gradients_with_respect_to_inputs_and_parameters():
    """The score of the plain filter, averaged over seeds, against the Kalman filter's."""
    keys = jax.random.split(jax.random.key(1), 100)
    filter = mpfjax.particle_filter(Driven(), 300, gradient="stop")

    def log_z(gain, u, key):
        own = eqx.tree_at(lambda f: f.model.gain, filter, gain)
        given = {"dt": jnp.asarray(INPUTS["dt"]), "u": u}
        run = mpfjax.run_filter(key, own, OBSERVATIONS, nothing, inputs=given)
        return run.log_marginal_likelihood

    def exact(gain, u):
        model, inputs = in_matrices(gain)
        run = kalman_filter(
            model, mpfjax.Series(OBSERVATIONS[:, None], inputs | {"inputs": u[:, None]})
        )
        return run.log_marginal_likelihood

    at = jnp.asarray(GAIN), jnp.asarray(INPUTS["u"])
    expected = jax.grad(exact, argnums=(0, 1))(*at)
    score = jax.vmap(jax.grad(log_z, argnums=(0, 1)), (None, None, 0))
    found = jax.jit(score)(*at, keys)
    for value, truth in zip(found, expected, strict=True):
        error = np.std(value, axis=0) / np.sqrt(len(keys))
        assert (error < 0.15).all()
        np.testing.assert_array_less(np.abs(np.mean(value, axis=0) - truth), 4 * error + 0.02)
