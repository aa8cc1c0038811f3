"""`check_model` accepts models that are right, and names what is wrong with others."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest
from jax.scipy.stats import cauchy, norm, poisson

import mpfjax
from tests import switching
from tests.marking import quick_of, weekly
from tests.user_models import DRIFT_AS_LINEAR_GAUSSIAN, Drift, DriftOfOne, ScalarLinear, TwoSensors

NUMBER = jnp.asarray(0.3)
ONE = mpfjax.LinearGaussianModel(A=[[0.9]], Q=[[0.3]], H=[[1.0]], R=[[0.4]], m0=[0.5], P0=[[1.0]])


class Observed(Drift):
    """With the two methods that only some tasks need."""

    def log_initial(self, states):
        return norm.logpdf(states).sum(axis=1)

    def sample_observation(self, key, states):
        return states[:, 0] + 0.7 * jax.random.normal(key, (len(states),))


class Returns(mpfjax.AbstractStateSpaceModel):
    """The state is the log variance of what is observed."""

    def sample_initial(self, key, num_particles):
        return -0.5 + jax.random.normal(key, (num_particles,))

    def sample_transition(self, key, states):
        return 0.97 * states + 0.25 * jax.random.normal(key, states.shape)

    def log_initial(self, states):
        return norm.logpdf(states, -0.5, 1.0)

    def log_transition(self, states, previous_states):
        return norm.logpdf(states, 0.97 * previous_states, 0.25)

    def log_likelihood(self, observation, states):
        return norm.logpdf(observation, 0.0, jnp.exp(states / 2))

    def sample_observation(self, key, states):
        return jnp.exp(states / 2) * jax.random.normal(key, states.shape)


class Plotted(Observed):
    """A place in the plane, by its range and bearing."""

    def log_likelihood(self, observation, states):
        far, angle = jnp.linalg.norm(states, axis=1), jnp.arctan2(states[:, 1], states[:, 0])
        errors = observation[None] - jnp.stack([far, angle], axis=1)
        return norm.logpdf(errors, 0.0, jnp.array([[0.5, 0.1]])).sum(axis=1)


def polar(key, plot, n):
    """Places around a range and a bearing, and their log density in the plane."""
    errors = jnp.array([[0.5, 0.1]]) * jax.random.normal(key, (n, 2))
    far, angle = (plot[None] + errors).T
    log_polar = norm.logpdf(errors, 0.0, jnp.array([[0.5, 0.1]])).sum(axis=1)
    return far[:, None] * jnp.stack([jnp.cos(angle), jnp.sin(angle)], 1), log_polar - jnp.log(far)


def radar(locate):
    """Objects that come and go in a disc, whose plots are ranges and bearings."""
    sensor = mpfjax.ClutteredModel(Plotted(), 0.9, 0.01)
    region = mpfjax.Disc([0.0, 0.0], 100.0)
    birth = mpfjax.UniformBirth(0.1, region, lambda key, places: places, locate)
    return mpfjax.TargetsModel(sensor, birth)


PLOTS = jnp.array([[jnp.nan, jnp.nan], [30.0, 0.5]])


class Guess(mpfjax.AbstractProposal):
    """Draws between the prediction and the observation."""

    scale: float = 0.6

    def propose(self, key, now, previous_states):
        noise = jax.random.normal(key, previous_states.shape)
        mean = 0.5 * (now.model.transition_mean(previous_states) + now.observation)
        return mean + 0.6 * noise, norm.logpdf(noise * 0.6, 0.0, self.scale).sum(axis=1)


class Known(Drift):
    """x_0 is known."""

    def sample_initial(self, key, num_particles):
        return jnp.zeros((num_particles, 2))


class Regimes(mpfjax.AbstractStateSpaceModel):
    """A regime that seldom changes, and steps without a variance."""

    def sample_initial(self, key, num_particles):
        zeros = jnp.zeros(num_particles, jnp.int32)
        return {"z": zeros, "x": jax.random.normal(key, (num_particles,))}

    def changes(self, key, num_particles):
        return jax.random.bernoulli(key, 0.1, (num_particles,))

    def sample_transition(self, key, states):
        key_z, key_x = jax.random.split(key)
        n = len(states["x"])
        z = jnp.where(self.changes(key_z, n), 1 - states["z"], states["z"])
        scale = jnp.where(z == 1, 1.0, 0.1)
        return {"z": z, "x": states["x"] + scale * jax.random.cauchy(key_x, (n,))}

    def log_transition(self, states, previous_states):
        z = states["z"]
        stays = jnp.where(z == previous_states["z"], jnp.log(0.9), jnp.log(0.1))
        scale = jnp.where(z == 1, 1.0, 0.1)
        return stays + cauchy.logpdf(states["x"], previous_states["x"], scale)

    def log_likelihood(self, observation, states):
        return norm.logpdf(observation, states["x"])


class Volatile(ScalarLinear):
    """The size of a step depends on the place."""

    def sample_transition(self, key, states):
        return 0.9 * states + jnp.exp(0.5 * states) * jax.random.normal(key, states.shape)

    def log_transition(self, states, previous_states):
        return norm.logpdf(states, 0.9 * previous_states, jnp.exp(0.5 * previous_states))


class Step(mpfjax.AbstractStateSpaceModel):
    """A step by any law: a draw, and its log density, of x given the x before."""

    draw: Callable = eqx.field(static=True)
    log_density: Callable = eqx.field(static=True)
    start: Callable = eqx.field(static=True, default=jax.random.normal)

    def sample_initial(self, key, num_particles):
        return self.start(key, (num_particles,))

    def sample_transition(self, key, states):
        return self.draw(key, states)

    def log_transition(self, states, previous_states):
        return self.log_density(states, previous_states)

    def log_likelihood(self, observation, states):
        return norm.logpdf(observation, states.astype(float), 2.0)


class BirthsAndDeaths(mpfjax.AbstractStateSpaceModel):
    """An object that walks, dies in one step of 200 and is born in one of 50, anywhere."""

    def sample_initial(self, key, num_particles):
        place = 10 * jax.random.normal(key, (num_particles,))
        return {"alive": jnp.ones(num_particles, bool), "place": place}

    def sample_transition(self, key, states):
        keys, (alive, place) = jax.random.split(key, 3), states.values()
        changes = jax.random.uniform(keys[0], place.shape) < jnp.where(alive, 0.005, 0.02)
        walked = place + 0.1 * jax.random.normal(keys[1], place.shape)
        born = 10 * jax.random.normal(keys[2], place.shape)
        now = alive != changes
        return {"alive": now, "place": jnp.where(now, jnp.where(alive, walked, born), 0.0)}

    def log_transition(self, states, previous_states):
        (now, place), (alive, before) = states.values(), previous_states.values()
        chance = jnp.where(alive, 0.005, 0.02)
        mean, deviation = jnp.where(alive, before, 0.0), jnp.where(alive, 0.1, 10.0)
        log_place = jnp.where(now, norm.logpdf(place, mean, deviation), 0.0)
        return jnp.log(jnp.where(now == alive, 1 - chance, chance)) + log_place

    def log_likelihood(self, observation, states):
        return jnp.where(states["alive"], norm.logpdf(observation, states["place"], 10.0), -5.0)


def chain(*rows):
    """A Markov chain of whole numbers."""
    logs = jnp.log(jnp.asarray(rows))

    def start(key, shape):
        return jax.random.randint(key, shape, 0, len(rows)).astype(jnp.int32)

    def draw(key, z):
        return jax.random.categorical(key, logs[z]).astype(jnp.int32)

    return Step(draw, lambda z, old: logs[old, z], start)


JUMPS = mpfjax.RandomWalkWithJumps([0.1], [5.0], 0.01)
STEPS = {
    "seldom jumps": Step(
        lambda key, x: JUMPS.sample(key, x[:, None], x[:, None])[:, 0],
        lambda x, old: JUMPS.log_density(x[:, None], old[:, None], old[:, None]),
    ),
    "a sticky chain": chain([0.999, 0.001], [0.01, 0.99]),
    "heavy tails": Step(
        lambda key, x: 0.5 * x + jax.random.cauchy(key, x.shape),
        lambda x, old: cauchy.logpdf(x, 0.5 * old),
    ),
    "counts": Step(
        lambda key, x: jax.random.poisson(key, 1 + 0.5 * x.astype(float)).astype(jnp.int32),
        lambda x, old: poisson.logpmf(x.astype(float), 1 + 0.5 * old.astype(float)),
        lambda key, shape: jax.random.poisson(key, 2.0, shape).astype(jnp.int32),
    ),
    "forgetful": Step(
        lambda key, x: jax.random.normal(key, x.shape), lambda x, old: norm.logpdf(x) + 0 * old
    ),
    "far": Step(
        lambda key, x: x + 0.1 * jax.random.normal(key, x.shape),
        lambda x, old: norm.logpdf(x, old, 0.1),
        lambda key, shape: 300.0 + jax.random.normal(key, shape),
    ),
}
RIGHT = {
    "births and deaths": (BirthsAndDeaths(), NUMBER),
    **{name: (step, NUMBER) for name, step in STEPS.items()},
    "batched": (Drift(), NUMBER),
    "observed": (Observed(), NUMBER),
    "returns": (Returns(), NUMBER),
    "objects": (radar(polar), PLOTS),
    "x_0 known": (Known(), NUMBER),
    "regimes": (Regimes(), NUMBER),
    "marginalised": (switching.MODEL, switching.OBSERVATIONS[0]),
    "of one particle": (mpfjax.per_particle(DriftOfOne()), NUMBER),
    "volatile": (Volatile(), NUMBER),
    "quadratic": (mpfjax.QuadraticModel(0.3, 0.5, -2.0, 2.0), NUMBER),
    "matrices": (DRIFT_AS_LINEAR_GAUSSIAN, jnp.array([0.3])),
    "two objects": (mpfjax.MultiObjectModel(ONE, 2), jnp.array([[0.3], [-1.0]])),
}


CASES = quick_of([(name, 8) for name in RIGHT], [], one_in=2)
CASES += weekly([(name, 1000) for name in RIGHT])


@pytest.mark.parametrize(("name", "num_keys"), CASES)
def test_what_is_right_is_accepted(name, num_keys, recwarn):
    for seed in range(num_keys):
        mpfjax.check_model(jax.random.key(seed), *RIGHT[name])
    assert not recwarn.list


def normal(x, mean, scale):
    return norm.logpdf(x, mean, scale).sum(axis=1)


# By name: the class that is right, the method in place of its own, and what is said of it.
WRONG = {
    "one noise for all x_0": (
        Drift, {"sample_initial": lambda self, key, n: jnp.full((n, 2), jax.random.normal(key))},
        "sample_initial draws noise that particles share",
    ),

    "one change of regime for all": (
        Regimes, {"changes": lambda self, key, n: jax.random.bernoulli(key, 0.1)},
        "sample_transition draws noise that particles share",
    ),
    "a key of its own": (
        Drift,
        {"sample_transition": lambda self, _, x: x + jax.random.normal(jax.random.key(3), x.shape)},
        "the same draws for every key",
    ),
    "NaN": (Drift, {"sample_transition": lambda self, key, x: jnp.log(x)}, "draws NaN"),
    "another deviation": (
        Drift, {"log_transition": lambda self, x, old: normal(x, self.transition_mean(old), 0.8)},
        "is not the log density of sample_transition",
    ),
    "a factor of the past": (
        Volatile,
        {"log_transition": lambda self, x, old: -0.5 * ((x - 0.9 * old) / jnp.exp(old / 2)) ** 2},
        "a factor that depends on x_",
    ),
    "zero at draws": (
        Drift, {"log_transition": lambda self, x, old: jnp.full(len(x), -jnp.inf)},
        "infinite at a draw of sample_transition",
    ),
    "normalised over particles": (
        Drift,
        {"log_likelihood": lambda self, y, x: jax.nn.log_softmax(norm.logpdf(y, x[:, 0]))},
        "depends on the other particles",
    ),
    "no particle": (
        Drift,
        {"log_likelihood": lambda self, y, x: jnp.where(x[:, 0] > 1e9, 0.0, -jnp.inf)},
        "no particle explains it",
    ),
}  # fmt: skip


def squared(scale):
    """A normal log density without its normaliser."""
    return lambda x, mean: -0.5 * ((x - mean) / scale) ** 2


def step(log_density):
    return lambda self, x, old: log_density(x, 0.97 * old)


# By name: the class that is right, and the method with one fault that a user makes.
PLANTED = {
    "a wrong sign": (Observed, "log_likelihood", lambda self, y, x: -squared(0.7)(y, x[:, 0])),
    "a density": (Observed, "log_likelihood", lambda self, y, x: norm.pdf(y, x[:, 0], 0.7)),
    "a variance": (Observed, "log_likelihood", lambda self, y, x: norm.logpdf(y, x[:, 0], 0.49)),
    "another number": (Observed, "log_likelihood", lambda self, y, x: norm.logpdf(y, x[:, 1], 0.7)),
    "no normaliser": (Returns, "log_likelihood", lambda self, y, x: squared(jnp.exp(x / 2))(y, 0)),
    "a variance for a scale": (
        Returns, "log_likelihood", lambda self, y, x: norm.logpdf(y, 0, jnp.exp(x)),
    ),
    "another x_0": (Observed, "log_initial", lambda self, x: norm.logpdf(x, 0.0, 2.0).sum(axis=1)),
    "half of x_0": (Observed, "log_initial", lambda self, x: norm.logpdf(x[:, 0])),
    "a density of x_0": (Returns, "log_initial", lambda self, x: norm.pdf(x, -0.5, 1.0)),
    "a density of x_t": (Returns, "log_transition", step(lambda x, m: norm.pdf(x, m, 0.25))),
    "a variance of x_t": (Returns, "log_transition", step(lambda x, m: norm.logpdf(x, m, 0.0625))),
    "no constant": (Returns, "log_transition", step(squared(0.25))),
    "one noise for all y": (
        Observed, "sample_observation",
        lambda self, key, x: x[:, 0] + 0.7 * jax.random.normal(key),
    ),
}  # fmt: skip


WRONG |= {
    name: (base, {method: faulty}, rf"\.{method} ")
    for name, (base, method, faulty) in PLANTED.items()
}


@pytest.mark.parametrize("name", quick_of(WRONG, ["no normaliser", "another x_0"]))
def test_what_is_wrong_is_named(name):
    base, methods, named = WRONG[name]
    with pytest.raises(ValueError, match=f"model: Changed.*{named}"):
        mpfjax.check_model(jax.random.key(0), type("Changed", (base,), methods)(), NUMBER)


def without_jacobian(key, plot, n):
    places, log_density = polar(key, plot, n)
    return places, log_density + jnp.log(jnp.linalg.norm(places, axis=1))


def as_density(key, plot, n):
    places, log_density = polar(key, plot, n)
    return places, jnp.exp(log_density)


@pytest.mark.exactness
@pytest.mark.parametrize("locate", [without_jacobian, as_density])
def test_places_of_new_objects_with_another_density_are_reported(locate):
    with pytest.raises(ValueError, match=r"birth\.locate's log density is not"):
        mpfjax.check_model(jax.random.key(0), radar(locate), PLOTS)


@pytest.mark.exactness
def test_a_proposal_must_have_the_density_of_its_draws():
    key = jax.random.key(0)
    mpfjax.check_model(key, Observed(), NUMBER, proposal=Guess())
    mpfjax.check_model(key, Observed(), NUMBER, proposal=mpfjax.GaussNewtonProposal())
    with pytest.raises(ValueError, match=r"proposal: Guess\.propose is not the log density"):
        mpfjax.check_model(key, Observed(), NUMBER, proposal=Guess(0.36))


class Careless(TwoSensors):
    def log_likelihood(self, observation, states):
        errors = jnp.where(
            jnp.isnan(observation)[None], 0.0, self.gain * (observation[None] - states)
        )
        return -0.5 * jnp.sum(errors**2, axis=1)


class Forgotten(TwoSensors):
    def log_likelihood(self, observation, states):
        return -0.5 * jnp.sum((observation[None] - self.gain * states) ** 2, axis=1)


def test_a_missing_number_must_leave_the_likelihood_and_its_derivative_finite(recwarn):
    key, seen = jax.random.key(0), jnp.array([0.3, 0.1])
    mpfjax.check_model(key, TwoSensors(), seen)
    assert not recwarn.list
    with pytest.warns(UserWarning, match=r"Careless.*derivative of NaN where a number is missing"):
        mpfjax.check_model(key, Careless(), seen)
    with pytest.raises(ValueError, match=r"Forgotten.*NaN where a number is missing"):
        mpfjax.check_model(key, Forgotten(), seen)
