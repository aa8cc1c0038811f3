"""MALA: Metropolis steps along the gradient, as a kind of Markov move of your own.

python -m examples.langevin
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

import mpfjax
from mpfjax.exact import kalman_filter


class Langevin(mpfjax.AbstractMetropolis):
    """Metropolis steps along the gradient: x' = x + s²/2 C ∇ log π(x) + s C^½ ξ, ξ ~ N(0, I).

    MALA (Roberts and Tweedie 1996) for π = D L. C is diagonal: the variances of the dynamics, from
    pairs of fresh draws for all parents. States are one array, (n, d).
    """

    def propose(
        self, key: Key[Array, ""], length: Float[Array, " n"], states: Float[Array, "n d"], target
    ) -> tuple[Float[Array, "n d"], Float[Array, " n"]]:
        """A step of the Langevin diffusion, and the reverse step's log density relative to it."""
        *keys, key_noise = jax.random.split(key, 3)
        a, b = (target.model.sample_transition(key, target.parents) for key in keys)
        unit = length[:, None] * jnp.sqrt(0.5 * jnp.mean((a - b) ** 2, axis=0))[None]

        def drift(states: Float[Array, "n d"]) -> Float[Array, "n d"]:
            """s/2 C^½ ∇ log π, in the units of the noise."""
            slopes = jax.grad(lambda states: sum(jnp.sum(each) for each in target(states)))(states)
            return 0.5 * unit * slopes

        noise, forth = jax.random.normal(key_noise, states.shape), drift(states)
        proposed = states + unit * (forth + noise)
        # The noise of the reverse step, from x' to x.
        reverse = forth + drift(proposed) + noise
        return proposed, jnp.sum(0.5 * (noise**2 - reverse**2), axis=1)


def main(num_runs: int = 600) -> tuple[float, float]:
    """The mean of Ẑ / Z over many runs, and its standard error."""
    eye = jnp.eye(2)
    model = mpfjax.LinearGaussianModel(
        A=0.9 * eye, Q=eye, H=eye, R=0.2 * eye, m0=[0.0, 0.0], P0=eye
    )
    observations = jnp.array([[0.5, 1.0], [1.0, 0.3], [0.2, -0.6]])
    moves = [mpfjax.Propagate(), mpfjax.Resample(), Langevin(), Langevin()]
    keys = jax.random.split(jax.random.key(0), num_runs)
    run = mpfjax.monte_carlo(
        keys, mpfjax.Filter(model, moves, 60), observations, lambda mixture: None
    )
    exact = kalman_filter(model, observations).log_marginal_likelihood
    ratios = jnp.exp(run.log_marginal_likelihood - exact)
    mean, error = float(jnp.mean(ratios)), float(jnp.std(ratios) / num_runs**0.5)
    print(f"mean of Ẑ / Z over {num_runs} runs: {mean:.3f} ± {error:.3f}")
    return mean, error


if __name__ == "__main__":
    main()
