"""The law in all the forms in which a user can write it."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.stats import norm

import mpfjax
from mpfjax.models.targets import AbstractBirth
from tests.matrix import law as exact
from tests.matrix.law import Law

BLIND = 1e9
"""An observation that no state can have made."""


def first(key, n):
    return jax.random.normal(key, (n,))


class Own(mpfjax.AbstractStateSpaceModel):
    """The three methods, and no more."""

    law: Law = eqx.field(converter=lambda law: Law(*map(jnp.asarray, law)))
    inputs: Any = None
    handles_missing: bool = eqx.field(static=True, default=False)

    def drift(self, x):
        return self.law.a * x + (0.0 if self.inputs is None else self.law.b * self.inputs)

    def sample_initial(self, key, num_particles):
        return self.law.m0 + self.law.p0 * first(key, num_particles)

    def sample_transition(self, key, states):
        return self.drift(states) + self.law.q * jax.random.normal(key, states.shape)

    def log_likelihood(self, observation, states):
        is_missing, is_blind = jnp.isnan(observation), observation > 0.5 * BLIND
        y = jnp.where(is_missing, 0.0, observation)
        values = norm.logpdf(y, self.law.c + states, self.law.r) + self.law.shift
        values = jnp.where(is_blind, -jnp.inf, values)
        return jnp.where(is_missing & self.handles_missing, 0.0, values)


class OfNoise(Own):
    """Made of noise, with densities, and what a Gauss-Newton proposal asks for."""

    noise_dimension = initial_noise_dimension = 1

    def sample_initial(self, key, num_particles):
        return self.initial_from_noise(first(key, num_particles)[:, None])

    def initial_from_noise(self, noise):
        return self.law.m0 + self.law.p0 * noise[:, 0]

    def log_initial(self, states):
        return norm.logpdf(states, self.law.m0, self.law.p0)

    sample_transition = mpfjax.AbstractStateSpaceModel.sample_transition

    def transition_from_noise(self, noise, states):
        return self.drift(states) + self.law.q * noise[:, 0]

    def log_transition(self, states, previous_states):
        return norm.logpdf(states, self.drift(previous_states), self.law.q)

    def transition_mean(self, states):
        return self.drift(states)

    def observation_mean(self, states):
        return self.law.c + states

    transition_covariance = property(lambda self: self.law.q**2)
    observation_covariance = property(lambda self: self.law.r**2)

    def sample_observation(self, key, states):
        return self.law.c + states + self.law.r * jax.random.normal(key, states.shape)


class InTree(OfNoise):
    """A state with a float, and a whole number that nothing uses."""

    def pack(self, x):
        return {"k": jnp.full(x.shape[:1], 3, jnp.int32), "x": x}

    def initial_from_noise(self, noise):
        return self.pack(super().initial_from_noise(noise))

    def log_initial(self, states):
        return super().log_initial(states["x"])

    def transition_from_noise(self, noise, states):
        return self.pack(super().transition_from_noise(noise, states["x"]))

    def log_transition(self, states, previous_states):
        return super().log_transition(states["x"], previous_states["x"])

    def log_likelihood(self, observation, states):
        return super().log_likelihood(observation, states["x"])

    def sample_observation(self, key, states):
        return super().sample_observation(key, states["x"])

    # Of a state that is one array.
    transition_mean = observation_mean = property()


class OfOne(eqx.Module):
    """The methods of one particle; not even a model."""

    model: OfNoise
    inputs: Any = None

    @property
    def own(self):
        return dataclasses.replace(self.model, inputs=self.inputs)

    def __getattr__(self, name):
        if name in ("law", "handles_missing", "noise_dimension", "initial_noise_dimension",
                    "transition_covariance", "observation_covariance"):  # fmt: skip
            return getattr(self.model, name)
        raise AttributeError(name)

    def sample_initial(self, key):
        return self.own.sample_initial(key, 1)[0]

    def initial_from_noise(self, noise):
        return self.own.initial_from_noise(noise[None])[0]

    def transition_from_noise(self, noise, state):
        return self.own.transition_from_noise(noise[None], state[None])[0]

    def log_initial(self, state):
        return self.own.log_initial(state)

    def log_transition(self, state, previous_state):
        return self.own.log_transition(state, previous_state)

    def log_likelihood(self, observation, state):
        return self.own.log_likelihood(observation, state)

    def transition_mean(self, state):
        return self.own.transition_mean(state)

    def observation_mean(self, state):
        return self.own.observation_mean(state)


class GoingRound(OfNoise):
    """A state with a period that is far larger than its spread."""

    periods = property(lambda self: 1000.0 * self.law.p0)


class Conditionally(mpfjax.AbstractConditionallyLinearModel):
    """Conditionally linear, with a latent that does nothing."""

    law: Law = eqx.field(converter=lambda law: Law(*map(jnp.asarray, law)))
    inputs: Any = None

    noise_dimension = 1

    def sample_initial(self, key, num_particles):
        return first(key, num_particles)[:, None]

    def log_initial(self, latent):
        return norm.logpdf(latent[:, 0])

    def transition_from_noise(self, noise, latent):
        return noise

    def log_transition(self, latent, previous_latent):
        return norm.logpdf(latent[:, 0])

    def initial_moments(self, latent):
        return self.law.m0.reshape(1), self.law.p0.reshape(1, 1) ** 2

    def dynamics(self, latent, previous_latent):
        push = jnp.zeros(()) if self.inputs is None else self.law.b * self.inputs
        return self.law.a.reshape(1, 1), push.reshape(1), self.law.q.reshape(1, 1) ** 2

    def emission(self, latent):
        return jnp.ones((1, 1)), self.law.c.reshape(1), self.law.r.reshape(1, 1) ** 2

    def linear_observation(self, observation):
        return jnp.where(observation > 0.5 * BLIND, jnp.nan, observation)

    def log_likelihood(self, observation, latent):
        seen = jnp.where(jnp.isnan(observation[0]), 0.0, self.law.shift)
        seen = jnp.where(observation[0] > 0.5 * BLIND, -jnp.inf, seen)
        return jnp.broadcast_to(seen, latent.shape[:1])


class Mixed(Conditionally):
    """The mixed form: the latent tells of x_{t-1}, and is not seen."""

    sample_transition = mpfjax.AbstractStateSpaceModel.sample_transition
    transition_from_noise = log_transition = property()

    def latent_dynamics(self, previous_latent):
        return jnp.zeros(1), jnp.full((1, 1), 0.3), jnp.ones((1, 1))


class Certain(AbstractBirth):
    """New objects that are like x_0."""

    law: Law
    rate: jax.Array = eqx.field(converter=jnp.asarray, default=1e-6)

    def sample(self, key, num_particles):
        return OfNoise(self.law).sample_initial(key, num_particles)

    def propose(self, key, measurement, num_particles, sensor=0):
        return self.sample(key, num_particles), jnp.zeros(num_particles)


class Steps(mpfjax.AbstractStateSpaceModel):
    """The chain of five whole numbers."""

    law: Law = eqx.field(converter=lambda law: Law(*map(jnp.asarray, law)))
    handles_missing: bool = eqx.field(static=True, default=False)

    def log_likelihood(self, observation, states):
        return Own.log_likelihood(self, observation, states.astype(float))

    def sample_initial(self, key, num_particles):
        return jax.random.randint(key, (num_particles,), 0, 5)

    def sample_transition(self, key, states):
        share = jax.random.uniform(key, states.shape)
        up = jnp.where(share < (1 - exact.STAY) / 2, 1, 0)
        down = jnp.where(share > (1 + exact.STAY) / 2, 1, 0)
        return jnp.clip(states + up - down, 0, 4)

    def log_transition(self, states, previous_states):
        rows = jnp.log(jnp.asarray(exact.chain_matrix(), float))
        return rows[previous_states, states]

    def log_initial(self, states):
        return jnp.full(states.shape, jnp.log(0.2))


def by_step(law, u):
    """u_t as the known inputs."""
    return np.asarray(u, np.float32)


def matrix_of(value):
    return jnp.asarray(value, float).reshape(1, 1)


def linear(law, **options):
    """In matrices, of which A, Q and B come with each step."""
    return mpfjax.LinearGaussianModel(
        A=jnp.zeros((1, 1)), Q=jnp.ones((1, 1)), H=jnp.ones((1, 1)), R=matrix_of(law.r) ** 2,
        m0=matrix_of(law.m0)[0], P0=matrix_of(law.p0) ** 2, B=jnp.zeros((1, 1)),
    )  # fmt: skip


def matrices_by_step(law, u):
    """The inputs of the same."""
    each = {"A": law.a, "Q": law.q**2, "B": law.b}
    fields = {name: jnp.full((len(u), 1, 1), value, jnp.float32) for name, value in each.items()}
    return fields | {"inputs": np.asarray(u, np.float32)[:, None]}


def switching(law, **options):
    """Two regimes that are alike."""
    two = jnp.full((2, 2), 0.5)
    q = jnp.stack([matrix_of(law.q) ** 2] * 2)
    return mpfjax.SwitchingLinearGaussianModel(
        two, F=jnp.stack([matrix_of(law.a)] * 2), Q=q, H=jnp.ones((1, 1)), c=matrix_of(law.c)[0],
        R=matrix_of(law.r) ** 2, m0=matrix_of(law.m0)[0], P0=matrix_of(law.p0) ** 2,
    )  # fmt: skip


def cluttered(law, **options):
    return mpfjax.ClutteredModel(OfNoise(law), detection_probability=1.0, clutter_density=1.0)


CLUTTER = 1e-4


def over_clutter(law, y, u):
    """The answer where log L is that over clutter alone."""
    return exact.kalman(law._replace(shift=-np.log(CLUTTER)), y, u)


def estimate_targets(law, **options):
    """One object that is certain: expected once, never dying, always seen, without clutter."""
    sensor = mpfjax.ClutteredModel(OfNoise(law), 1.0, CLUTTER)
    return mpfjax.TargetsModel(sensor, Certain(law), 1.0, initial_number=1.0)


class Form(NamedTuple):
    """A form of the law, and how to ask it."""

    make: Callable[..., Any]
    """the model of a `Law`, with `handles_missing` where it is a form of the model's own class."""
    value: Callable[[Any], Any] = lambda states: states.reshape(states.shape[0])
    """x of each state, (n,)."""
    rows: bool = False
    """whether an observation is an array of one number."""
    inputs: Callable[..., Any] | None = None
    answer: Callable[..., exact.Answer] = exact.kalman
    data: str = "own"
    """which data it has: those of a class of one's own, or fewer."""
    offset: Callable[[Any], Any] | None = lambda model: model.law.c
    """the model's c, where it has one."""
    within: Callable[[Any], Any] = lambda states: 0.0
    """Var[x] given each state."""


def moments_of(form: Form):
    """E[x] and Var[x] by a mixture; the mean is that of the library."""

    def moments(mixture):
        row = jax.tree.map(lambda leaf: leaf[None], mixture.mean())
        values = form.value(mixture.particles)
        spread = mixture.variance(values)
        return form.value(row)[0], spread + mixture.expectation(
            form.within(mixture.particles) + values * 0
        )

    return moments


def own(kind):
    return lambda law, **options: kind(law, **options)


# Of particles that carry moments.
MOMENTS: dict[str, Any] = {
    "value": lambda states: states.mean[:, 0],
    "within": lambda states: states.covariance[:, 0, 0],
    "rows": True,
}
FORMS: dict[str, Form] = {
    "three methods": Form(own(Own)),
    "made of noise": Form(own(OfNoise)),
    "tree": Form(own(InTree), lambda states: states["x"]),
    "per particle": Form(
        lambda law, **options: mpfjax.per_particle(OfOne(OfNoise(law, **options))),
        offset=lambda model: model.model.model.law.c,
        inputs=by_step,
    ),
    "inputs": Form(own(OfNoise), inputs=by_step),
    "matrices by step": Form(
        linear, rows=True, inputs=matrices_by_step, data="plain", offset=None
    ),
    "conditionally linear": Form(
        own(Conditionally), inputs=by_step, data="parts", **MOMENTS
    ),
    "mixed": Form(own(Mixed), data="parts", **MOMENTS),
    "switching": Form(switching, data="plain", offset=lambda model: model.c, **MOMENTS),
    "one of several": Form(
        lambda law, **options: mpfjax.MultiObjectModel(OfNoise(law, **options), 1),
        rows=True, inputs=by_step, offset=lambda model: model.object_model.law.c,
    ),
    "cluttered": Form(
        cluttered, rows=True, data="sets", offset=lambda model: model.object_model.law.c
    ),
    "targets": Form(estimate_targets, rows=True, data="targets", offset=None, answer=over_clutter),
    "periodic": Form(own(GoingRound)),
    "whole numbers": Form(
        own(Steps), lambda states: states.astype(float), answer=exact.enumerated, data="whole"
    ),
}  # fmt: skip
