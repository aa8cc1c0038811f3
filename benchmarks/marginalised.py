"""What a Kalman filter in every particle costs, and what it brings.

    python -m benchmarks.marginalised --parts time
    python -m benchmarks.marginalised --parts regimes
    python -m benchmarks.marginalised --parts bearings

`time`: propagation and weighing of a state of two latent and four linear numbers, of which
particles draw the latent ones alone, beside `Propagate`, which draws all six; in turns, processor
time by particle and step, and the median of the turns' ratios. "shared noise" is the mixed form,
in which the latent numbers depend on the linear ones.

`regimes`: a target with three regimes in four dimensions, which is the example of dynamax's
`rbpfilter_optimal`. The error of the regimes' probabilities is that from a filter of --reference
particles that looks at all children, as RMS over steps and seeds. dynamax takes part where it is
installed (pip install --no-deps dynamax; pip install tfp-nightly dm-tree fastprogress==1.0.3). The
last column is the filter's error over that of the best of ours in the same time, between whose
sizes the logarithms are interpolated.

`bearings`: the scene of docs/masses.md. Errors of the masses and of log Ẑ over --runs keys and
processor time of a run, as a ratio, of the mixture filter of 1000 particles, the same with
marginalised velocity, and the filters of --learned-sizes that look ahead by what passes of 16 000
particles learned. The time to learn, which is spent once for a series, is a column of its own;
compiling is left out of it.

Into --out DIR goes marginalised.json.
"""

import importlib.util
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key, PyTree

import mpfjax
from benchmarks import harness
from benchmarks.harness import AtLeast2, Count, command
from benchmarks.masses.__main__ import results, summary, truth
from benchmarks.masses.filters import FILTERS
from benchmarks.masses.scenes import SCENES, with_marginalised_velocity

Once = Callable[[int], Any]
PARTS = ("time", "regimes", "bearings")
OURS = ("marginalised", "fully adapted", "all children")
STAYS, DYNAMICS, ERRORS = 0.8, 0.2, 10 * np.array([2.0, 1.0, 2.0, 1.0])
_HOW = "dynamax is not there: pip install --no-deps dynamax; pip install tfp-nightly dm-tree"


@command(
    particles=[20], steps=3, sizes=[10, 20], dynamax_sizes=[10], learned_sizes=[20], runs=3,
    seeds=2, repeats=2, reference=200,
)  # fmt: skip
def main(
    *,
    parts: Sequence[Annotated[str, (*PARTS,)]] = PARTS,
    particles: Sequence[Count] = (1000, 4000, 16_000, 64_000),
    sizes: Sequence[Count] = (10, 30, 100, 300, 1000, 3000),
    dynamax_sizes: Sequence[Count] = (10, 30, 100, 300),
    learned_sizes: Sequence[Count] = (100, 150, 200, 1000),
    runs: AtLeast2 = 100,
    steps: Count = 100,
    seeds: AtLeast2 = 20,
    repeats: Count = 15,
    reference: Count = 100_000,
    out: Path = Path("results/marginalised"),
) -> None:
    """Part by part; what is finished is written.

    - `particles`: of the part on time.
    - `sizes`: of the part on regimes.
    - `dynamax_sizes`: of dynamax, whose program grows with N.
    - `learned_sizes`: of the part on bearings.
    - `runs`: of the part on bearings.
    - `repeats`: turns, each of all that run.
    """
    settings, found = harness.settings_of(locals()), {}
    tables = {
        "time": lambda: time_of_steps(particles, steps, repeats),
        "regimes": lambda: regimes(sizes, dynamax_sizes, steps, seeds, reference, repeats),
        "bearings": lambda: bearings(learned_sizes, steps, runs, reference, repeats),
    }
    for part in parts:
        found[part] = tables[part]()
        print(harness.table(None, found[part]))
        harness.data(out / "marginalised.json", settings=settings, results=found)
    print(f"results: {out}/")


def milliseconds(runs: dict[Any, Once], repeats: int) -> dict[Any, np.ndarray]:
    """Processor time of each, turn by turn."""
    runs = {name: lambda _, once=once: once(0) for name, once in runs.items()}
    taken = harness.turns(runs, repeats, clock=time.process_time)
    return {name: 1000 * seconds for name, seconds in taken.items()}


def evidence(filter: mpfjax.Filter, observations: Array) -> Once:
    """log Ẑ of a seed."""
    return lambda seed: (
        mpfjax.run_filter(
            jax.random.key(seed), filter, observations, harness.nothing
        ).log_marginal_likelihood
    )


class SixNumbers(mpfjax.AbstractStateSpaceModel):
    """Two numbers that move by four others, all drawn; two of the six are seen."""

    noise_dimension = 6

    def sample_initial(self, key: Key[Array, ""], num_particles: int) -> Float[Array, "n 6"]:
        """Standard normal numbers."""
        return mpfjax.normal(key, (num_particles, 6))

    def transition_from_noise(
        self, noise: Float[Array, "n 6"], states: Float[Array, "n 6"]
    ) -> Float[Array, "n 6"]:
        """Each number by its own, and by the one two places on."""
        return 0.9 * states + 0.1 * jnp.roll(states, 2, axis=1) + 0.3 * noise

    def log_likelihood(
        self, observation: Float[Array, "2"], states: Float[Array, "n 6"]
    ) -> Float[Array, " n"]:
        """Gaussian errors."""
        missed = observation[0] - jnp.sin(states[:, 0]) - states[:, 2]
        other = observation[1] - jnp.sin(states[:, 1]) - states[:, 3]
        return -0.5 * (missed**2 + other**2)


class TwoAndFour(mpfjax.AbstractConditionallyLinearModel):
    """The same with two latent numbers and moments of four."""

    def sample_initial(self, key: Key[Array, ""], num_particles: int) -> Float[Array, "n 2"]:
        """Standard normal numbers."""
        return mpfjax.normal(key, (num_particles, 2))

    def initial_moments(self, latent: Float[Array, "n 2"]) -> tuple[Array, Array]:
        """Those of standard normal numbers."""
        del latent
        return jnp.zeros(4), jnp.eye(4)

    def sample_transition(
        self, key: Key[Array, ""], latent: Float[Array, "n 2"]
    ) -> Float[Array, "n 2"]:
        """By their own alone."""
        return 0.9 * latent + 0.3 * mpfjax.normal(key, latent.shape)

    def dynamics(
        self, latent: Float[Array, "n 2"], previous_latent: Float[Array, "n 2"]
    ) -> tuple[Array, Array, Array]:
        """Of which the offset depends on the latent."""
        del latent
        offset = 0.1 * jnp.concatenate([previous_latent, jnp.zeros_like(previous_latent)], axis=1)
        return 0.9 * jnp.eye(4) + 0.1 * jnp.eye(4, k=-2), offset, 0.09 * jnp.eye(4)

    def emission(self, latent: Float[Array, "n 2"]) -> tuple[Array, Array, Array]:
        """Two of the four, beside a function of the latent."""
        return jnp.eye(2, 4), jnp.sin(latent), jnp.eye(2)


class SharedNoise(TwoAndFour):
    """The mixed form, in which the latent moves by the linear numbers."""

    def latent_dynamics(self, previous_latent: Float[Array, "n 2"]) -> tuple[Array, Array, Array]:
        """By the last two of the four."""
        return 0.9 * previous_latent, 0.1 * jnp.eye(2, 4, k=2), 0.09 * jnp.eye(2)


def time_of_steps(sizes: Sequence[int], steps: int, repeats: int) -> list[dict[str, Any]]:
    """Nanoseconds a particle and step of each move, by N."""
    observations = jax.random.normal(jax.random.key(1), (steps, 2))
    moves = {
        "plain": mpfjax.Propagate(SixNumbers()),
        "marginalised": mpfjax.PropagateMarginalised(TwoAndFour()),
        "marginalised, mixed": mpfjax.PropagateMarginalised(SharedNoise()),
    }
    rows = []
    for size in sizes:
        runs = {
            name: evidence(mpfjax.Filter(move.model, [move], size), observations)
            for name, move in moves.items()
        }
        taken = milliseconds(runs, repeats)
        rows += [
            {"move": name, "N": size,
             "ns a particle and step": 1e6 * float(times.min()) / size / steps,
             "over the plain one": harness.ratio(times, taken["plain"])}
            for name, times in taken.items()
        ]  # fmt: skip
    return rows


def manoeuvre() -> mpfjax.SwitchingLinearGaussianModel:
    """Positions and velocities, (x, x', y, y'), pushed to one side, to the other, or not at all."""
    A = np.eye(4) + np.diag([1.0, 0.0, 1.0], k=1)
    pushes = np.outer([0.0, -1.0, 1.0], [1.225, 0.35, -1.225, -0.35])
    return mpfjax.SwitchingLinearGaussianModel(
        transition_matrix=(STAYS - 0.1) * np.eye(3) + 0.1,
        F=A, b=jnp.asarray(pushes), Q=DYNAMICS * np.eye(4), H=np.eye(4), R=np.diag(ERRORS),
        m0=np.zeros(4), P0=1e-6 * np.eye(4), initial_probabilities=jnp.full(3, 1 / 3),
    )  # fmt: skip


class AllDrawn(mpfjax.AbstractStateSpaceModel):
    """The same target, of which particles draw everything."""

    target: mpfjax.SwitchingLinearGaussianModel

    def sample_initial(self, key: Key[Array, ""], num_particles: int) -> PyTree:
        """At rest in the middle, in any regime."""
        latent = self.target.sample_initial(key, num_particles)
        return {"latent": latent, "x": jnp.zeros((num_particles, 4))}

    def sample_transition(self, key: Key[Array, ""], states: PyTree) -> PyTree:
        """The regime, and the state by it."""
        key_latent, key_state = jax.random.split(key)
        latent = self.target.sample_transition(key_latent, states["latent"])
        F, b, _ = self.target.dynamics(latent, states["latent"])
        noise = np.sqrt(DYNAMICS) * mpfjax.normal(key_state, states["x"].shape)
        return {"latent": latent, "x": states["x"] @ F.T + b + noise}

    def log_likelihood(self, observation: Float[Array, "4"], states: PyTree) -> Float[Array, " n"]:
        """Gaussian errors."""
        squares = (observation[None] - states["x"]) ** 2 / jnp.asarray(ERRORS[None], jnp.float32)
        return -0.5 * jnp.sum(squares, axis=1)


def simulated(model: mpfjax.SwitchingLinearGaussianModel, steps: int) -> Float[Array, "t 4"]:
    """What is seen of a target, by numpy."""
    rng, regime, state, rows = np.random.default_rng(0), 0, np.zeros(4), []
    F, b = np.asarray(model.F, float), np.asarray(model.b, float)
    for _ in range(steps):
        regime = rng.choice(3, p=np.where(np.arange(3) == regime, STAYS, (1 - STAYS) / 2))
        state = F @ state + b[regime] + np.sqrt(DYNAMICS) * rng.normal(size=4)
        rows.append(state + np.sqrt(ERRORS) * rng.normal(size=4))
    return jnp.asarray(np.array(rows), jnp.float32)


def shares(weights: Float[Array, " n"], regime: Int[Array, " n"]) -> Float[Array, "3"]:
    """The probability of each regime."""
    return jnp.stack([jnp.sum(jnp.where(regime == k, weights, 0.0)) for k in range(3)])


def of_mixture(mixture: mpfjax.ParticleMixture) -> Float[Array, "3"]:
    """The same of a mixture."""
    particles = mixture.particles
    latent = particles["latent"] if isinstance(particles, dict) else particles.latent
    return shares(mixture.weights, latent)


def regimes(
    sizes: Sequence[int], dynamax_sizes: Sequence[int], steps: int, seeds: int, reference: int,
    repeats: int,
) -> list[dict[str, Any]]:  # fmt: skip
    """Time and error of each filter and size."""
    model = manoeuvre()
    observations = simulated(model, steps)
    every = lambda size: mpfjax.Filter(model, [mpfjax.PropagateRegimes(model)], size)  # noqa: E731
    proposal = mpfjax.RegimeProposal(model)
    makes: dict[str, Callable[[int], mpfjax.Filter]] = {
        "plain": lambda size: mpfjax.particle_filter(AllDrawn(model), size),
        "marginalised": lambda size: mpfjax.particle_filter(model, size),
        "fully adapted": lambda size: mpfjax.auxiliary_particle_filter(model, size, proposal),
        "all children": every,
    }
    runs: dict[tuple[str, int], Once] = {
        (name, size): filtered(make(size), observations)
        for name, make in makes.items()
        for size in sizes
    }
    if importlib.util.find_spec("dynamax") is None:
        print(f"{_HOW} fastprogress==1.0.3")
    else:
        runs |= {("dynamax", size): by_dynamax(model, observations, size) for size in dynamax_sizes}
    known = np.asarray(filtered(every(reference), observations)(0))
    errors = {
        name: float(np.sqrt(np.mean([(once(s) - known) ** 2 for s in range(seeds)])))
        for name, once in runs.items()
    }
    taken = {name: float(np.median(times)) for name, times in milliseconds(runs, repeats).items()}

    def error_at(at: float, name: str) -> float:
        """In a time: between the filter's sizes on a line of logarithms, else the end."""
        points = sorted((np.log(taken[key]), np.log(errors[key])) for key in runs if key[0] == name)
        x, y = np.array(points).T
        return float(np.exp(np.interp(np.log(at), x, y)))

    return [
        {"filter": key[0], "N": key[1], "ms a run": at, "RMS error": errors[key],
         "over our best then": errors[key] / min(error_at(at, own) for own in OURS)}
        for key, at in taken.items()
    ]  # fmt: skip


def filtered(filter: mpfjax.Filter, observations: Array) -> Once:
    """The regimes' probabilities of a seed."""
    return lambda seed: (
        mpfjax.run_filter(jax.random.key(seed), filter, observations, of_mixture).collected
    )


def by_dynamax(model: mpfjax.SwitchingLinearGaussianModel, observations: Array, size: int) -> Once:
    """The same by dynamax's filter with the optimal proposal."""
    from dynamax.slds import inference  # pyright: ignore[reportMissingImports]

    of_each = lambda array: jnp.broadcast_to(array, (3, *array.shape))  # noqa: E731
    nothing = jnp.zeros((3, 4, 1))
    parameters = inference.ParamsSLDS(
        discrete=inference.DiscreteParamsSLDS(
            initial_distribution=jnp.full(3, 1 / 3),
            transition_matrix=model.transition_matrix,
            proposal_transition_matrix=model.transition_matrix,
        ),
        linear_gaussian=inference.LGParamsSLDS(
            initial_mean=of_each(model.m0), initial_cov=of_each(model.P0),
            dynamics_weights=of_each(model.F), dynamics_cov=of_each(model.Q),
            dynamics_bias=jnp.asarray(model.b), dynamics_input_weights=nothing,
            emission_weights=of_each(model.H), emission_cov=of_each(model.R),
            emission_bias=jnp.zeros((3, 4)), emission_input_weights=nothing, initialized=True,
        ),
    )  # fmt: skip

    @jax.jit
    def once(key: Array) -> Float[Array, "t 3"]:
        found = inference.rbpfilter_optimal(size, parameters, observations, key)
        return jax.vmap(shares)(found["weights"], found["states"])

    return lambda seed: once(jax.random.PRNGKey(seed))


def bearings(
    sizes: Sequence[int], steps: int, runs: int, reference: int, repeats: int
) -> list[dict[str, Any]]:
    """Errors and time of each filter, and what was spent on learning."""
    scene = SCENES["bearings"][0](steps, 0)
    velocity = with_marginalised_velocity(scene)
    known = truth(scene, reference, 1)
    plain, size = FILTERS["MPF"], 1000
    for _ in range(2):  # the first one compiles
        start = time.process_time()
        learned = FILTERS["MPF, learned look-ahead"](scene, size)
        jax.block_until_ready(jax.tree.leaves(learned))
        seconds = time.process_time() - start
    rows = {
        ("MPF", size): (scene, plain(scene, size), 0.0),
        ("MPF, marginalised velocity", size): (velocity, plain(velocity, size), 0.0),
    }
    for fewer in sizes:
        filter = learned.replace(num_particles=fewer)
        rows["MPF, learned look-ahead", fewer] = scene, filter, seconds
    observations = jnp.asarray(scene.observations)
    once = {name: evidence(filter, observations) for name, (_, filter, _) in rows.items()}
    taken, found = milliseconds(once, repeats), []
    for name, (own, filter, spent) in rows.items():
        errors = summary(results(own, filter, runs, 0), known, own.truth)
        found.append({
            "filter": name[0], "N": name[1], "error of masses": errors["mass_rmse"],
            "error of log Ẑ": errors["log_z_rmse"],
            "time of a run": harness.ratio(taken[name], taken["MPF", size]), "s to learn": spent,
        })  # fmt: skip
    return found


if __name__ == "__main__":
    raise SystemExit(main())
