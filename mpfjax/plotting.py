"""Pictures of runs: each function draws into `ax` and returns it. Only here matplotlib is used."""

from collections.abc import Iterator, Sequence
from typing import Any

import jax
import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Array, Float, PyTree
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba
from matplotlib.patches import Ellipse

from mpfjax.checks import CountOrZero, checked, shown
from mpfjax.mixture import ParticleMixture, flatten_states
from mpfjax.running.results import FilterRun
from mpfjax.tuning import optimisation, summaries

# Okabe and Ito's palette (2008), which people with colour blindness can tell apart.
COLOURS = (
    "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00",
    "#56B4E9", "#F0E442", "#8B4513", "#5E3C99", "#666666",
)  # fmt: skip
MARKERS = "osD^vP*X<>"
# A component of less weight is hardly darker than the paper, and many would fill the legend.
_LEAST_WEIGHT = 0.01
_PALE = np.array([1.0, 1.0, 1.0, 0.3])  # of the spread, in RGBA


@checked
def draw_components(
    run: FilterRun | ParticleMixture,
    index: CountOrZero = 0,
    *,
    truth: np.ndarray | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Each component's mean and two standard deviations over time, the darker the heavier.

    The moments of component m are E[x | c = m] and Cov[x | c = m]. Those of a conditionally linear
    model hold the Gaussians of the particles and the spread between them.

    - `run`: a run with its mixtures, `run_filter(..., collect=None)`, or these mixtures.
    - `index`: the coordinate of the flattened state; of a `MarginalisedState` the latent comes
      first, then x.
    - `truth`: (t,), a line in black.

    Components with a weight below 0.01 are left out.

    Raises `ValueError` for an index that the state has not, and for mixtures without an axis of
    time. Use it to see where modes part, and the probability of each.
    """
    weights, means, covariances = _moments(run, index)
    ax = _axes(ax, "time step $t$", f"coordinate {index} of the state")
    for m, t, colours in _living(ax, weights):
        mean, sd = means[t, m, index], np.sqrt(covariances[t, m, index, index])
        ax.vlines(t + 1, mean - 2 * sd, mean + 2 * sd, colors=colours * _PALE, lw=3)
        ax.scatter(t + 1, mean, s=9, lw=0, c=colours)
    return _with_truth(ax, None if truth is None else (np.arange(1, len(weights) + 1), truth))


@checked
def draw_plane(
    run: FilterRun | ParticleMixture,
    indices: tuple[int, int] = (0, 1),
    *,
    truth: np.ndarray | None = None,
    ax: Axes | None = None,
) -> Axes:
    """The components over time in the plane of two coordinates, the darker the heavier.

    Each has a dot at its mean and the ellipse of two standard deviations. The arguments are those
    of `draw_components`; `truth` is (t, 2). Raises `ValueError` as it does.
    """
    weights, means, covariances = _moments(run, *indices)
    ax = _axes(ax, *(f"coordinate {index} of the state" for index in indices))
    ax.set_aspect("equal")
    for m, t, colours in _living(ax, weights):
        places, plane = means[t, m][:, indices], np.ix_(range(len(t)), indices, indices)
        squares, ways = np.linalg.eigh(covariances[t, m][plane])
        sides = 4 * np.sqrt(np.maximum(squares, 0))
        for place, sizes, way, colour in zip(places, sides, ways, colours * _PALE, strict=True):
            angle = np.degrees(np.arctan2(way[1, 1], way[0, 1]))
            ax.add_patch(Ellipse(tuple(place), *sizes[::-1], angle=angle, fc=colour, lw=0))
        ax.scatter(*places.T, s=9, lw=0, c=colours)
    return _with_truth(ax, None if truth is None else truth.T)


@checked
def draw_weights(run: FilterRun | ParticleMixture, *, ax: Axes | None = None) -> Axes:
    """The mixture weights over time, stacked; `run` is as for `draw_components`."""
    weights, _, _ = _moments(run)
    ax = _axes(ax, "time step $t$", "mixture weights")
    for m in np.flatnonzero(weights.max(axis=0) >= _LEAST_WEIGHT):
        below, times = weights[:, :m].sum(axis=1), np.arange(1, len(weights) + 1)
        colour = COLOURS[m % len(COLOURS)]
        ax.fill_between(times, below, below + weights[:, m], color=colour, alpha=0.7, lw=0)
        ax.plot([], [], lw=4, color=colour, label=f"component {m}")
    ax.set_ylim(0, 1)
    return _with_truth(ax, None)


@checked
def draw_diagnostics(run: FilterRun, *, ax: Axes | None = None) -> Axes:
    """The effective sample size over time, and on the right axis the increments of log Z.

    Of the runs of `monte_carlo` each has a line. Steps with all weight on one particle, and large
    negative increments, are where a filter loses the state.
    """
    ax = _axes(ax, "time step $t$", "effective sample size")
    sizes, increments = run.effective_sample_size, run.log_likelihood_increments
    right, times = ax.twinx(), np.arange(1, sizes.shape[-1] + 1)
    for axis, values, colour in ((ax, sizes, COLOURS[0]), (right, increments, COLOURS[1])):
        lines = np.asarray(values).reshape(-1, len(times))
        axis.plot(times, lines.T, color=colour, lw=1, alpha=max(0.2, 1 / len(lines)))
        axis.yaxis.label.set_color(colour)
    right.set_ylabel("increment of log Z")
    if sizes.min() < 0.1 * sizes.max():
        ax.set_yscale("log")
    return ax


@checked
def draw_paths(
    paths: PyTree,
    modes: Sequence[Any] | np.ndarray | Array | None = None,
    *,
    index: CountOrZero = 0,
    ax: Axes | None = None,
) -> Axes:
    """Smoothed paths over time in one coordinate, those of a mode in one colour.

    - `paths`: of `smoothing.sample_trajectories`, leaves (k, t + 1, ...), from x_0 on.
    - `modes`: (k,), the mode of each path, such as the sign of its last state; None is one mode.
    - `index`: the coordinate of the flattened state.
    """
    rows = np.asarray(jax.vmap(flatten_states)(paths))
    _check_index(index, rows.shape[2])
    ax = _axes(ax, "time step $t$", f"coordinate {index} of the state")
    labels = np.zeros(len(rows), int) if modes is None else np.asarray(modes)
    for mode, colour in zip(np.unique(labels), COLOURS, strict=False):
        lines = rows[labels == mode, :, index].T
        ax.plot(lines, color=colour, lw=0.6, alpha=max(0.05, min(1.0, 10 / len(rows))))
        share = lines.shape[1] / len(rows)
        label = "paths" if modes is None else f"mode {mode}: {share:.0%} of the paths"
        ax.plot([], [], color=colour, label=label)
    return _with_truth(ax, None)


@checked
def draw_tuning(run: optimisation.TuningRun, *, ax: Axes | None = None) -> Axes:
    """The parameters of `tuning.fit` or `maximise` over its steps, each number a line."""
    ax = _axes(ax, "step of the optimiser", "parameters")
    history = {name: np.asarray(run.history[name]) for name in run.parameters}
    for k, (name, line) in enumerate(summaries.numbers_of(history, 1).items()):
        ax.plot(line, color=COLOURS[k % len(COLOURS)], label=name)
    return _with_truth(ax, None)


def _axes(ax: Axes | None, xlabel: str, ylabel: str) -> Axes:
    ax = plt.figure(figsize=(7.0, 3.4), layout="constrained").subplots() if ax is None else ax
    ax.set(xlabel=xlabel, ylabel=ylabel)
    ax.grid(alpha=0.25)
    return ax


def _with_truth(ax: Axes, truth: Any) -> Axes:
    """The axes with a legend, and the ground truth where it is known."""
    if truth is not None:
        ax.plot(*truth, color="black", lw=1, label="ground truth")
    ax.legend(fontsize=8)
    return ax


def _check_index(index: int, size: int) -> None:
    if index >= size:
        raise ValueError(f"index: {shown(index)} of a state of {size} numbers")


def _moments(
    run: FilterRun | ParticleMixture, *indices: int
) -> tuple[Float[np.ndarray, "t m"], Float[np.ndarray, "t m d"], Float[np.ndarray, "t m d d"]]:
    """Weights, means and covariances of the components at each step."""
    mixtures = run.collected if isinstance(run, FilterRun) else run
    if not isinstance(mixtures, ParticleMixture) or mixtures.log_weights.ndim != 2:
        raise ValueError("run: it has not the mixtures of one run; collect them by collect=None")

    def moments(mixture: ParticleMixture) -> tuple[Array, Array, Array]:
        means = flatten_states(mixture.component_means())
        return mixture.mixture_weights, means, mixture.component_covariances()

    weights, means, covariances = map(np.asarray, jax.jit(jax.vmap(moments))(mixtures))
    for index in indices:
        _check_index(index, means.shape[2])
    diagonal = np.einsum("tmii->tmi", covariances := covariances.copy())
    diagonal[...] = np.maximum(diagonal, 0.0)  # rounding may leave it slightly negative
    return weights, means, covariances


def _living(ax: Axes, weights: Float[np.ndarray, "t m"]) -> Iterator[tuple[int, Any, Any]]:
    """Of each component that is ever alive: its number, its steps, and a colour for each of them.

    It has an entry in the legend.
    """
    for m in np.flatnonzero(weights.max(axis=0) >= _LEAST_WEIGHT).tolist():
        steps = np.flatnonzero(weights[:, m] >= _LEAST_WEIGHT)
        colours = np.tile(to_rgba(COLOURS[m % len(COLOURS)]), (len(steps), 1))
        ax.plot([], [], "o", ms=4, color=tuple(colours[0]), label=f"component {m} (mean, 2 sd)")
        colours[:, 3] = np.minimum(0.15 + 0.85 * weights[steps, m], 1.0)
        yield m, steps, colours
