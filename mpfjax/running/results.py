"""The result of a run: what it collected, its moments over time, and tables of its components."""

import html
import math
from collections.abc import Callable, Sequence
from typing import Annotated, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, PyTree

from mpfjax.checks import SHARES, Renamed, checked
from mpfjax.mixture import MarginalisedState, ParticleMixture, flatten_states, points

_MOST_COLUMNS = 6  # coordinates of the state that a table has room for


class FilterRun(eqx.Module):
    """The result of running a filter over observations y_1..y_t; `print` shows it with a table.

    - `log_marginal_likelihood`: log p(y_1..y_t), estimated: the sum of the increments.
    - `log_likelihood_increments`: of each step, -inf where every particle had zero likelihood.
    - `collected`: what `collect` made of each step's mixture, stacked over t.
    - `initial`: the mixture of x_0, before any observation.
    - `final`: the mixture after the last step.
    - `resampled`: which components each step resampled.
    - `degenerate`: the steps at which every particle had zero likelihood.
    - `broken`: the steps whose increment is NaN or +inf. Within a caller's `jax.jit` nothing can be
      raised: check it outside.
    - `effective_sample_size`: 1 / Σ W², of the joint weights W of all particles after each step.
    - `log_evidence_against_start`: that of each step's `StepInfo`, and None unless a move of the
      filter tells it.
    - `alarm`: the steps at which all hypotheses seem wrong, since the cumulative sum of that
      evidence is above 5. It never falls below zero nor rises above 10 (a CUSUM, Page 1954). None
      likewise.

    `mean`, `variance` and `quantile` are moments of the filtering distribution at each step, of one
    run or of the runs of `monte_carlo`. They raise `ValueError` unless the mixtures were collected,
    as by the default `collect=None`.
    """

    log_marginal_likelihood: Float[Array, ""]
    log_likelihood_increments: Float[Array, " t"]
    collected: PyTree
    initial: ParticleMixture
    final: ParticleMixture
    resampled: Bool[Array, "t m"]
    degenerate: Bool[Array, " t"]
    effective_sample_size: Float[Array, " t"]
    log_evidence_against_start: Float[Array, " t"] | None
    alarm: Bool[Array, " t"] | None
    surprised = Renamed("surprised", "alarm")

    @property
    def broken(self) -> Bool[Array, "..."]:
        """The steps whose increment of log Ẑ is NaN or +inf."""
        return ~(self.log_likelihood_increments < jnp.inf)

    def mean(self) -> PyTree:
        """E[x_t | y_1..y_t] of each step, leaves (t, ...), as `ParticleMixture.mean`."""
        return _of_each(ParticleMixture.mean, self._mixtures())

    def variance(self) -> PyTree:
        """Var[x_t | y_1..y_t] of each number of the state, leaves (t, ...).

        What goes round, by the model's `periods`, differs from its mean by the shorter way. Of a
        `MarginalisedState` it is the pair of that of the latent and that of x_t.
        """
        return _of_each(_variance, self._mixtures())

    @checked
    def quantile(
        self,
        q: Annotated[float | Sequence[float] | Float[Array, "*q"], SHARES],
        values: Callable[[PyTree], Array] | None = None,
    ) -> PyTree:
        """Weighted quantiles of each step, leaves (t, q, ...); (t, ...) for one number q.

        - `values`: a function of the particles whose quantiles they are, as `lambda states:
          states["speed"]`; None is each number of the state.

        Raises `ValueError` for a `MarginalisedState` without `values`, since the means of its
        particles spread less than x_t does.
        """
        mixtures = self._mixtures()
        if values is None and isinstance(mixtures.particles, MarginalisedState):
            raise ValueError("values: None, and a MarginalisedState has means; use a function")
        return _of_each(_quantiles, mixtures, jnp.asarray(q), values)

    def _mixtures(self) -> ParticleMixture:
        if not isinstance(self.collected, ParticleMixture):
            how = "run the filter with collect=None, or collect lambda mixture: mixture.mean()"
            raise ValueError(f"collect: the run did not collect its mixtures; {how}")
        return self.collected

    def __repr__(self) -> str:
        value = self.log_marginal_likelihood
        if isinstance(value, Tracer) or not isinstance(value, jax.Array | np.ndarray):
            return super().__repr__()
        return f"{self._headline()}\n{self._table() or ''}".rstrip()

    def _repr_html_(self) -> str:
        table = self._table()
        below = "" if table is None else table._repr_html_()
        return f"<p>{html.escape(self._headline())}</p>{below}"

    def _headline(self) -> str:
        *runs, steps = self.log_likelihood_increments.shape
        log_z, sizes = map(np.asarray, (self.log_marginal_likelihood, self.effective_sample_size))
        what = f"{log_z.size} runs of {steps} steps" if runs else f"run of {steps} steps"
        spread = f" ± {log_z.std():.2g}" if runs else ""
        low, middle = sizes.min(), np.median(sizes)
        return (
            f"{what}: log Z = {log_z.mean():.6g}{spread}; effective sample size {low:.3g} at least,"
            f" {middle:.3g} in the median; {int(np.sum(self.degenerate))} degenerate steps"
        )

    def _table(self) -> "ComponentTable | None":
        return None if self.log_likelihood_increments.ndim > 1 else component_table(self.final)


def append_last(rows: PyTree, row: PyTree) -> PyTree:
    """The rows of the earlier times, followed by the row of the last time."""
    return jax.tree.map(lambda before, end: jnp.concatenate([before, end[None]]), rows, row)


def after_first(row: PyTree, rows: PyTree) -> PyTree:
    """The row of the first time, followed by the rows of the later times."""
    return jax.tree.map(
        lambda first, later: jnp.concatenate([first[None].astype(later.dtype), later]), row, rows
    )


def format_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in plain text, columns aligned to the right but for the first."""
    widths = [max(len(line[i]) for line in [header, *rows]) for i in range(len(header))]

    def format_line(cells: Sequence[str]) -> str:
        first, *rest = zip(cells, widths, strict=True)
        return "  ".join([first[0].ljust(first[1]), *(cell.rjust(width) for cell, width in rest)])

    rule = "  ".join("-" * width for width in widths)
    return "\n".join([format_line(header), rule, *map(format_line, rows)])


class ComponentTable(NamedTuple):
    """The living components of a mixture, the heaviest first; `print` and notebooks show it."""

    columns: tuple[str, ...]
    """their names."""
    rows: tuple[tuple[str, ...], ...]
    """one for each living component: texts."""

    def __str__(self) -> str:
        return format_table(self.columns, self.rows)

    __repr__ = __str__

    def _repr_html_(self) -> str:
        def row(cells: Sequence[str], tag: str) -> str:
            return "<tr>" + "".join(f"<{tag}>{html.escape(c)}</{tag}>" for c in cells) + "</tr>"

        body = "".join(row(each, "td") for each in self.rows)
        return f"<table>{row(self.columns, 'th')}{body}</table>"


@checked
def component_table(mixture: ParticleMixture) -> ComponentTable:
    """The living components: mixture weight, effective sample size, mean and standard deviation.

    The deviations are those of each coordinate of the flattened state, and the first six
    coordinates have a column. Dead components do not appear. Raises `ValueError` for a stack of
    mixtures: `component_table(run.final)`, or of step t, `jax.tree.map(lambda leaf: leaf[t - 1],
    run.collected)`.
    """
    weights, sizes, means, variances = map(np.asarray, _components(mixture))
    shown = _coordinates(mixture.particles)[:_MOST_COLUMNS]
    columns = ("component", "weight", "eff. size", *(f"{name} (mean ± sd)" for name in shown))
    rows = []
    for m in np.argsort(-weights):
        if weights[m] > 0:
            pairs = zip(means[m], np.sqrt(variances[m]), strict=True)
            moments = [_mean_and_deviation(float(mean), float(sd)) for mean, sd in pairs]
            rows.append((str(m), f"{weights[m]:.3f}", f"{sizes[m]:.1f}", *moments[: len(shown)]))
    return ComponentTable(columns, tuple(rows))


def _mean_and_deviation(mean: float, deviation: float) -> str:
    """Both with as many decimals as two digits of the deviation need."""
    if not (deviation >= 1e-4 and max(abs(mean), deviation) < 1e6):
        return f"{mean:.4g} ± {deviation:.2g}"
    decimals = max(0, 1 - math.floor(math.log10(deviation)))
    return f"{mean:.{decimals}f} ± {deviation:.{decimals}f}"


def _coordinates(particles: PyTree) -> list[str]:
    """The names of the numbers of the flattened state."""
    names = []
    for path, leaf in jax.tree_util.tree_leaves_with_path(points(particles)):
        name = "x" + jax.tree_util.keystr(path)
        names += [name + str(list(at)) * bool(at) for at in np.ndindex(*leaf.shape[1:])]
    return names


@eqx.filter_jit
def _components(mixture: ParticleMixture) -> tuple[Array, Array, Array, Array]:
    means = flatten_states(mixture.component_means())
    variances = mixture.component_covariances().diagonal(axis1=1, axis2=2)
    sizes = mixture.component_effective_sample_sizes
    return mixture.mixture_weights, sizes, means, jnp.maximum(variances, 0.0)


@eqx.filter_jit
def _of_each(function: Callable[..., PyTree], mixtures: ParticleMixture, *arguments: Any) -> PyTree:
    """A function of each mixture of a stack, one after the other."""
    shape = mixtures.log_weights.shape[:-1]
    rows = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[len(shape) :]), mixtures)
    values = jax.lax.map(lambda mixture: function(mixture, *arguments), rows)
    return jax.tree.map(lambda leaf: leaf.reshape(*shape, *leaf.shape[1:]), values)


def _variance(mixture: ParticleMixture) -> PyTree:
    together = mixture.replace(
        component_indicators=jnp.zeros_like(mixture.component_indicators), num_components=1
    )
    _, unravel = ravel_pytree(points(mixture.mean()))
    return unravel(jnp.maximum(together.component_covariances()[0].diagonal(), 0.0))


def _quantiles(
    mixture: ParticleMixture, q: Float[Array, "*q"], values: Callable[[PyTree], Array] | None
) -> PyTree:
    if values is not None:
        return mixture.quantile(values, q)
    return jax.tree.map(lambda leaf: mixture.quantile(leaf, q), mixture.particles)
