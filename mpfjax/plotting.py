"""Pictures of a run: its components over time. Only here matplotlib is used."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure

from mpfjax.checks import CountOrZero, checked, shown
from mpfjax.mixture import ParticleMixture, flatten_states

# Okabe and Ito's palette (2008), which people with colour blindness can tell apart.
COLOURS = (
    "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00",
    "#56B4E9", "#F0E442", "#8B4513", "#5E3C99", "#666666",
)  # fmt: skip
MARKERS = "osD^vP*X<>"
# A component of less mass is hardly darker than the paper, and many would fill the legend.
_LEAST_MASS = 0.01


@checked
def draw_components(
    mixtures: ParticleMixture,
    index: CountOrZero = 0,
    *,
    truth: np.ndarray | None = None,
) -> Figure:
    """Each component's mean and two standard deviations over time, the darker the heavier.

    The moments of component m are E[x | c = m] and Cov[x | c = m]. Those of a conditionally linear
    model hold the Gaussians of the particles and the spread between them.

    - `mixtures`: with a leading axis of time, as `run_filter(..., collect=None).collected`.
    - `index`: which number of the flattened state is drawn; of a `MarginalisedState` the latent
      comes first, then x.
    - `truth`: (t,), a line in black.

    Components of less than a hundredth of the mass are left out.

    Raises `ValueError` for an index that the state has not, and for mixtures without an axis of
    time. Use it to see where modes part, and how much of the mass each has.
    """
    if mixtures.log_weights.ndim != 2:
        raise ValueError("mixtures: these are not all of one run; keep them by collect=None")

    def moments(mixture: ParticleMixture) -> tuple[Array, Array, Array]:
        means = flatten_states(mixture.component_means())
        covariances = mixture.component_covariances()
        # Rounding may leave a variance of zero slightly negative.
        variances = jnp.maximum(covariances.diagonal(axis1=1, axis2=2), 0.0)
        return mixture.mixture_weights, means, variances

    masses, means, variances = map(np.asarray, jax.vmap(moments)(mixtures))
    if index >= means.shape[2]:
        raise ValueError(f"index: {shown(index)} of a state of {means.shape[2]} numbers")
    figure = Figure(figsize=(7.0, 3.4), layout="constrained")
    axis = figure.subplots()
    times = np.arange(1, len(masses) + 1)
    for m in range(masses.shape[1]):
        alive = masses[:, m] >= _LEAST_MASS
        if not alive.any():
            continue
        mean, deviation = means[alive, m, index], np.sqrt(variances[alive, m, index])
        colour = COLOURS[m % len(COLOURS)]
        # Rounding may leave a mass slightly above one.
        opacity = np.minimum(0.15 + 0.85 * masses[alive, m], 1.0)
        bars = [to_rgba(colour, 0.4 * alpha) for alpha in opacity]
        dots = [to_rgba(colour, alpha) for alpha in opacity]
        low, high = mean - 2 * deviation, mean + 2 * deviation
        axis.vlines(times[alive], low, high, colors=bars, lw=3)
        axis.scatter(times[alive], mean, s=9, lw=0, c=dots, label=f"component {m + 1}")
    if truth is not None:
        axis.plot(times, truth, color="black", lw=1, label="true state")
    axis.set(xlabel="time step $t$", ylabel=f"state, number {index}")
    axis.set_title("components: mean ± 2 standard deviations, darker for more mass", fontsize=10)
    axis.grid(alpha=0.25)
    legend = figure.legend(loc="outside lower center", fontsize=8, ncols=5)
    for handle in legend.legend_handles:
        if handle is not None:
            handle.set_alpha(1.0)
    return figure
