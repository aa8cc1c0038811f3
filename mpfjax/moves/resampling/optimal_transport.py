"""Resampling without draws: an entropy-regularised transport plan within each component."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from mpfjax.mixture import ParticleMixture
from mpfjax.operations.indexing import take
from mpfjax.operations.segments import spread

# In units of the regularisation: e^-APART is nothing in any floating point type.
_APART = 1e4
_THRESHOLD = 1e-3
_MOST_ITERATIONS = 500


def require_ott() -> None:
    """Raise an `ImportError` that names the extra where ott-jax is missing."""
    try:
        import ott  # noqa: F401
    except ImportError as error:
        raise ImportError("gradient='ot' needs ott-jax: pip install ott-jax") from error


def transport(
    mixture: ParticleMixture,
    targets: Int[Array, " n"],
    components: Int[Array, " n"],
    filled: Bool[Array, " n"],
    regularisation: float,
) -> tuple[PyTree, Int[Array, " n"]]:
    """x̃_s = Σ_j P_sj x_j / Σ_j P_sj, and the j of the largest P_sj, for every slot s.

    Within each component, P is a transport plan from the weights w_j of its particles to equal
    weights on the particles `targets_s`, one for each slot. It minimises <P, C> - ε H(P), where
    C_sj is the squared distance in units of the component's spread (Corenflos et al. 2021, eq. 9
    and section 4.1). Leaves that are not floating point are copied from the particle j of the
    largest P_sj.
    """
    states = _float_leaves(mixture)
    points = take(states, targets)
    same = components[None] == mixture.component_indicators[:, None]
    squares = jnp.sum((states[:, None] - points[None]) ** 2, axis=2)
    scale = spread(_squared_scales(mixture, states), mixture.component_indicators)
    cost = jnp.where(same, squares / scale[:, None], _APART * regularisation)
    plan = _plan(cost, *_marginals(mixture, components, filled, states.dtype), regularisation).T
    rows = jnp.sum(plan, axis=1, keepdims=True)
    shares = plan / jnp.where(rows > 0, rows, 1.0)
    nearest = jnp.argmax(plan, axis=1).astype(jnp.int32)

    def move(leaf: Array) -> Array:
        if not jnp.issubdtype(leaf.dtype, jnp.floating):
            return take(leaf, nearest)
        flat = jnp.where(mixture.occupied[:, None], leaf.reshape(leaf.shape[0], -1), 0.0)
        return (shares.astype(leaf.dtype) @ flat).reshape(leaf.shape)

    return jax.tree.map(move, mixture.particles), nearest


def _float_leaves(mixture: ParticleMixture) -> Float[Array, "n d"]:
    leaves = [leaf for leaf in jax.tree.leaves(mixture.particles) if _is_float(leaf)]
    if not leaves:
        raise ValueError("gradient: 'ot' moves particles, and their states hold no floating point")
    flat = jnp.concatenate([leaf.reshape(leaf.shape[0], -1) for leaf in leaves], axis=1)
    return jnp.where(mixture.occupied[:, None], flat, 0.0)


def _is_float(leaf: Array) -> bool:
    return jnp.issubdtype(leaf.dtype, jnp.floating)


def _squared_scales(mixture: ParticleMixture, states: Float[Array, "n d"]) -> Float[Array, " m"]:
    """d times the largest variance of a coordinate, over the particles of each component."""
    states = jax.lax.stop_gradient(states)
    present = mixture.occupied.astype(states.dtype)[:, None]
    counts = jnp.maximum(mixture.component_sums(present), 1.0)
    means = mixture.component_sums(present * states) / counts
    centred = states - spread(means, mixture.component_indicators)
    variances = mixture.component_sums(present * centred**2) / counts
    scales = states.shape[1] * jnp.max(variances, axis=1)
    return jnp.where(scales > 0, scales, 1.0)


def _marginals(
    mixture: ParticleMixture,
    components: Int[Array, " n"],
    filled: Bool[Array, " n"],
    dtype: jnp.dtype,
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """The weights of particles and of slots, every living component with an equal mass."""
    num_living = jnp.maximum(jnp.sum(mixture.active.astype(dtype)), 1.0)
    present = filled.astype(dtype)
    counts = jax.ops.segment_sum(present, components, mixture.num_components)
    sources = mixture.component_weights.astype(dtype) / num_living
    return sources, present / (num_living * jnp.maximum(spread(counts, components), 1.0))


def _plan(
    cost: Float[Array, "n s"],
    sources: Float[Array, " n"],
    slots: Float[Array, " s"],
    regularisation: float,
) -> Float[Array, "n s"]:
    from ott.geometry.geometry import Geometry
    from ott.solvers import linear

    # The solver needs JAX's default promotion, whatever its caller has set. Its iterations are
    # differentiated one by one: the implicit derivative solves a linear system that weights near
    # zero make singular, and that of a fixed number of iterations is wrong in ott-jax 0.6.
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        geometry = Geometry(cost_matrix=cost, epsilon=regularisation, relative_epsilon=None)
        solution: Any = linear.solve(
            geometry,
            sources,
            slots,
            implicit_diff=None,
            threshold=_THRESHOLD,
            max_iterations=_MOST_ITERATIONS,
        )
        return solution.matrix
