"""Label likelihoods: exact on a model whose posterior is known, and with a best scale."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from jax.scipy.stats import norm

import mpfjax
from mpfjax.mixture import MarginalisedState
from mpfjax.models.base import AbstractStateSpaceModel
from mpfjax.tuning import LabelLikelihood, Positive, maximise
from mpfjax.tuning.labels import transition_candidates
from tests import switching


class Unnormalised(AbstractStateSpaceModel):
    """x_t = x_{t-1} + N(0, 1), and exp(-lambda (y - x)^2 + c y^2), which is no density of y."""

    lambda_: jax.Array = eqx.field(converter=jnp.asarray, default=1.0)
    c: jax.Array = eqx.field(converter=jnp.asarray, default=0.0)

    def sample_initial(self, key, num_particles):
        return jax.random.normal(key, (num_particles,))

    def sample_transition(self, key, states):
        return states + jax.random.normal(key, states.shape)

    def log_likelihood(self, observation, states):
        return -self.lambda_ * (observation - states) ** 2 + self.c * observation**2


SIGMA = 0.5  # of the noise in y: the right lambda is 1 / (2 sigma^2) = 2


def data(num_frames, num_candidates, num_labels=1):
    key = jax.random.key(0)
    key_states, key_noise, key_candidates = jax.random.split(key, 3)
    steps = jax.random.normal(key_states, (num_frames + 1, num_labels))
    labels = jnp.cumsum(steps, axis=0)
    noise = SIGMA * jax.random.normal(key_noise, (num_frames, 1))
    observations = (labels[1:, :1] + noise)[:, 0]
    rivals = transition_candidates(key_candidates, Unnormalised(), labels, num_candidates)
    return observations, labels, rivals


def test_each_label_has_its_own_candidates():
    observations, labels, rivals = data(3, 5, num_labels=2)
    model = Unnormalised(lambda_=0.7)
    found = np.asarray(LabelLikelihood(observations, labels[1:], rivals).log_posteriors(model))
    for t in range(3):
        for k in range(2):
            states = np.concatenate([labels[1 + t, k][None], rivals[t, k]])
            likelihoods = np.exp(-0.7 * (float(observations[t]) - states) ** 2)
            expected = np.log(likelihoods[0] / likelihoods.mean())
            assert found[t, k] == pytest.approx(expected, abs=1e-4)
            assert found[t, k] <= np.log(6) + 1e-5


@pytest.mark.exactness
def test_of_a_conditionally_linear_model_labels_carry_moments():
    """A known x has no variance: L is then N(y; H x + c, R) of the regime, in numpy."""
    model, y = switching.MODEL, switching.OBSERVATIONS[:2]
    regimes, places = np.array([[0], [2]], np.int32), np.array([[[0.5, 0.0]], [[-0.3, 0.2]]])
    labels = MarginalisedState(
        jnp.asarray(regimes), jnp.asarray(places, jnp.float32), jnp.zeros((2, 1, 2, 2))
    )
    rivals = transition_candidates(jax.random.key(0), model, labels, 50)
    last = jax.tree.map(lambda leaf: leaf[1:], labels)
    found = LabelLikelihood(y[1:], last, rivals).log_posteriors(model)
    latents = np.append(regimes[1], rivals.latent)
    means = np.concatenate([places[1], np.asarray(rivals.mean).reshape(50, 2)])[:, 0]
    variances = np.append(0.0, np.asarray(rivals.covariance)[..., 0, 0])
    noise = np.ravel(switching.PARTS["R"])[latents]
    logs = norm.logpdf(float(y[1, 0]), means, np.sqrt(variances + noise))
    expected = logs[0] - np.log(np.mean(np.exp(logs)))
    np.testing.assert_allclose(found[0, 0], expected, atol=1e-4)
    Q, F, b = (np.array(switching.PARTS[name]) for name in "QFb")
    z = np.ravel(rivals.latent)
    np.testing.assert_allclose(rivals.mean[0, 0], F[z] @ places[0, 0] + b[z], atol=1e-5)
    np.testing.assert_allclose(rivals.covariance[0, 0], Q[z], atol=1e-6)


@pytest.mark.exactness
def test_the_scale_has_a_best_value_and_a_factor_of_y_none():
    observations, labels, rivals = data(400, 60)
    objective = LabelLikelihood(observations, labels[1:], rivals)
    run = maximise(
        jax.random.key(1), Unnormalised(lambda_=0.2), objective, optax.adam(0.1), 80,
        parameters={"lambda": lambda model: model.lambda_}, transforms={"lambda": Positive()},
        progress=False,
    )  # fmt: skip
    # Of 400 labels, its standard error is about 0.15.
    assert run.parameters["lambda"] == pytest.approx(0.5 / SIGMA**2, abs=0.6)
    assert run.value > run.history["value"][0] + 0.1
    assert float(run.tuned.lambda_) == run.parameters["lambda"]
    slope = jax.grad(lambda model: objective(jax.random.key(0), model))(run.tuned)
    assert abs(float(slope.c)) < 1e-4
    assert abs(float(slope.lambda_)) < 0.02


def parabola(key, model):
    return -((model.lambda_ - 3.0) ** 2)


LAMBDA = {"parameters": {"lambda": lambda m: m.lambda_}, "progress": False}


def ascent(objective=parabola, num_steps=60, **options):
    arguments = (jax.random.key(0), Unnormalised(), objective, optax.sgd(0.1), num_steps)
    return maximise(*arguments, **LAMBDA | options)


def test_a_function_is_an_objective():
    run = ascent()
    assert run.parameters["lambda"] == pytest.approx(3.0, abs=1e-3)
    np.testing.assert_allclose(run.history["lambda"][:2], [1.0, 1.4], rtol=1e-5)
    assert run.value == pytest.approx(0.0, abs=1e-4)


@pytest.mark.parametrize("wrap", [lambda function: function, eqx.filter_jit])
def test_it_goes_on_from_a_checkpoint_of_the_same_objective(tmp_path, wrap):
    def part(num_steps):
        objective = wrap(lambda key, model: -((model.lambda_ - 3.0) ** 2))
        checkpoint = mpfjax.Checkpoint(tmp_path / "ascent.npz")
        return ascent(objective, num_steps, checkpoint=checkpoint)

    part(3)
    np.testing.assert_array_equal(
        part(6).parameters["lambda"], ascent(num_steps=6).parameters["lambda"]
    )
