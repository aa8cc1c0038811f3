"""What a Kalman filter in every particle costs, and what it brings.

    python -m benchmarks.marginalised

A target with three regimes in four dimensions, which is the example of dynamax's
`rbpfilter_optimal`. The error of the regimes' probabilities is that from a filter of --reference
particles that looks at all children, as RMS over steps and seeds. The last column is the filter's
error over that of the best of ours in the same time, between whose sizes the logarithms are
interpolated.

Into --out DIR goes marginalised.json.
"""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key, PyTree

import mpfjax
from benchmarks import harness
from benchmarks.harness import AtLeast2, Count, command

Once = Callable[[int], Any]
OURS = ("marginalised", "fully adapted", "all children")
STAYS, DYNAMICS, ERRORS = 0.8, 0.2, 10 * np.array([2.0, 1.0, 2.0, 1.0])


@command(steps=3, sizes=[10, 20], seeds=2, repeats=2, reference=200)
def main(
    *,
    sizes: Sequence[Count] = (10, 30, 100, 300, 1000, 3000),
    steps: Count = 100,
    seeds: AtLeast2 = 20,
    repeats: Count = 15,
    reference: Count = 100_000,
    out: Path = Path("results/marginalised"),
) -> None:
    """The table.

    - `sizes`: N of each filter.
    - `repeats`: turns, each of all that run.
    """
    settings = harness.settings_of(locals())
    rows = regimes(sizes, steps, seeds, reference, repeats)
    print(harness.table(None, rows))
    harness.data(out / "marginalised.json", settings=settings, results=rows)
    print(f"results: {out}/")


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


def of_mixture(mixture: mpfjax.ParticleMixture) -> Float[Array, "3"]:
    """The probability of each regime."""
    particles, weights = mixture.particles, mixture.weights
    regime = particles["latent"] if isinstance(particles, dict) else particles.latent
    return jnp.stack([jnp.sum(jnp.where(regime == k, weights, 0.0)) for k in range(3)])


def regimes(
    sizes: Sequence[int], steps: int, seeds: int, reference: int, repeats: int
) -> list[dict[str, Any]]:
    """Time and error of each filter and size."""
    model = manoeuvre()
    observations = simulated(model, steps)
    every = lambda size: mpfjax.Filter(model, [mpfjax.PropagateRegimes()], size)  # noqa: E731
    proposal = mpfjax.RegimeProposal()
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
    answer = np.asarray(filtered(every(reference), observations)(0))
    errors = {
        name: float(np.sqrt(np.mean([(once(s) - answer) ** 2 for s in range(seeds)])))
        for name, once in runs.items()
    }
    calls = {name: lambda _, once=once: once(0) for name, once in runs.items()}
    seconds = harness.turns(calls, repeats, clock=time.process_time)
    milliseconds = {name: 1000 * float(np.median(times)) for name, times in seconds.items()}

    def error_at(at: float, name: str) -> float:
        """In a time: between the filter's sizes on a line of logarithms, else the end."""
        points = sorted(
            (np.log(milliseconds[key]), np.log(errors[key])) for key in runs if key[0] == name
        )
        x, y = np.array(points).T
        return float(np.exp(np.interp(np.log(at), x, y)))

    return [
        {"filter": key[0], "N": key[1], "ms a run": at, "RMS error": errors[key],
         "over our best then": errors[key] / min(error_at(at, own) for own in OURS)}
        for key, at in milliseconds.items()
    ]  # fmt: skip


def filtered(filter: mpfjax.Filter, observations: Array) -> Once:
    """The regimes' probabilities of a seed."""
    return lambda seed: (
        mpfjax.run_filter(jax.random.key(seed), filter, observations, of_mixture).collected
    )


if __name__ == "__main__":
    raise SystemExit(main())
