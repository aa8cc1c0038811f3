"""Tempered propagation: the likelihood enters by powers, and particles move in between.

    python -m examples.tempered_propagation

The step of a sequential Monte Carlo sampler as a move of your own. It is exact, and no part of the
library, since as many more particles as it takes time do better: in the scene "mirror" of
`benchmarks.masses` 400 particles with four stages have an RMSE of log Ẑ of 2.07 (± .29, 60 runs),
and 1600 particles without, in less time, .75 (± .07).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key, PyTree

import mpfjax
from mpfjax import ParticleMixture, Resample, Step
from mpfjax.exact import grid_filter
from mpfjax.models.base import require_noise
from mpfjax.moves.base import AbstractPropagation, AbstractWrapper
from mpfjax.moves.propagation.propagate import predict


class Tempered(eqx.Module):
    """What is resampled between the stages: x_{t-1}, x_t, the noise that made it, and log L."""

    parents: PyTree
    states: PyTree
    noise: Float[Array, "n d"]
    log_likelihoods: Float[Array, " n"]


class PropagateTempered(AbstractPropagation, AbstractWrapper):
    """Draw x_t ~ D, then weigh it by L^β1, L^(β2-β1), ... up to L, moving particles in between.

    As in a sequential Monte Carlo sampler (Del Moral, Doucet and Jasra 2006). After each stage but
    the last, particles are resampled within components and move: x_t = f(z, x_{t-1}) is drawn again
    from z' = sqrt(1 - s²) z + s ξ, and accepted with the probability min(1, (L' / L)^β), the
    preconditioned Crank-Nicolson step (Cotter and others 2013). log s is uniform between log 0.02
    and 0. The model makes x_t of noise, `transition_from_noise`.
    """

    resample: Resample = Resample()
    exponents: tuple[float, ...] = eqx.field(static=True, default=(1 / 64, 1 / 16, 1 / 4, 1.0))

    holds = ("resample",)
    biases_score = True
    """a derivative does not see which moves are accepted."""

    def check(self, now: Step, num_particles: int, num_components: int) -> None:
        """Raise a `ValueError` for a model that does not make x_t of noise."""
        super().check(now, num_particles, num_components)
        require_noise(now.model, "PropagateTempered")

    def __call__(self, key: Key[Array, ""], mixture: ParticleMixture, now: Step) -> ParticleMixture:
        """Propagate every particle and weigh it by y_t, stage by stage."""
        if now.is_missing:
            return predict(key, now.law, mixture, "none", "independent")
        key_noise, *keys = jax.random.split(key, 1 + len(self.exponents))
        before, parents = mixture, mixture.particles
        noise = jax.random.normal(key_noise, (mixture.num_particles, now.model.noise_dimension))
        mixture, below = mixture.replace(particles=self._make(noise, parents, now)), 0.0
        for stage, (key, exponent) in enumerate(zip(keys, self.exponents, strict=True)):
            if stage:
                key_draw, key_move = jax.random.split(key)
                mixture = self.resample.resample(key_draw, mixture)
                mixture = self._move(key_move, mixture, now, below)
            log_likelihoods = mixture.particles.log_likelihoods
            mixture, below = mixture.reweight((exponent - below) * log_likelihoods), exponent
        return mixture.replace(particles=mixture.particles.states).with_resampled_of(before)

    def _make(self, noise: Float[Array, "n d"], parents: PyTree, now: Step) -> Tempered:
        states = now.law.make(noise, parents)
        return Tempered(parents, states, noise, now.law.log_likelihood(now.observation, states))

    def _move(
        self, key: Key[Array, ""], mixture: ParticleMixture, now: Step, exponent: float
    ) -> ParticleMixture:
        """Each particle after one Metropolis step in its noise, with the same parent."""
        here = mixture.particles
        key_step, key_noise, key_taken = jax.random.split(key, 3)
        step = 0.02 ** jax.random.uniform(key_step, (mixture.num_particles, 1))
        fresh = jax.random.normal(key_noise, here.noise.shape)
        new = self._make(jnp.sqrt(1 - step**2) * here.noise + step * fresh, here.parents, now)
        log_ratio = exponent * (new.log_likelihoods - here.log_likelihoods)
        is_accepted = jnp.log(jax.random.uniform(key_taken, log_ratio.shape)) < log_ratio

        def chosen(new: Array, old: Array) -> Array:
            return jnp.where(is_accepted.reshape(-1, *[1] * (new.ndim - 1)), new, old)

        return mixture.replace(particles=jax.tree.map(chosen, new, here))


def main(num_runs: int = 600) -> tuple[float, float]:
    """The mean of Ẑ / Z over many runs, and its standard error."""
    model, observations = mpfjax.QuadraticModel(0.5, 0.02, -2.0, 2.0), jnp.array([1.0, 1.4, 0.9])
    exact = grid_filter(model, observations, jnp.linspace(-4.0, 4.0, 4001))
    filter = mpfjax.Filter(model, [Resample(), PropagateTempered()], 60)
    keys = jax.random.split(jax.random.key(0), num_runs)
    run = mpfjax.monte_carlo(keys, filter, observations, lambda mixture: None)
    ratios = jnp.exp(run.log_marginal_likelihood - exact.log_marginal_likelihood)
    mean, error = float(jnp.mean(ratios)), float(jnp.std(ratios) / num_runs**0.5)
    print(f"mean of Ẑ / Z over {num_runs} runs: {mean:.3f} ± {error:.3f}")
    return mean, error


if __name__ == "__main__":
    main()
