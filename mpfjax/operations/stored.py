"""What XLA computes once and keeps, branches that runs take together, gathers and scatters.

In numpy: `values.copy()`, `values.astype(int)`, `values[indices]`, `np.bincount(places)` and
`np.where(chosen[:, None], new, old)`, with as many `None` as the arrays need. XLA
fuses a computation into everything that uses its result, and then repeats it for every use. It does
not fuse across the call of a function that it must not inline, and a call that does nothing takes
no time. Nor does it fuse across a condition. Under `vmap`, `jax.lax.cond` becomes a `where` as soon
as its condition differs from run to run, and both branches run. Where the expensive branch gives
the right result for every run, the runs can choose together: if one needs it, all take it.

An operation has one form for CPUs and another for all other platforms.
"""

import inspect
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
from jax.core import Tracer
from jax.experimental.xla_metadata import set_xla_metadata
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Int, Key, PyTree, Shaped

# JAX 0.6 marks all operations within a context, and later versions those that made a value too.
_MARKS_VALUES = "x" in inspect.signature(set_xla_metadata).parameters
_only_the_default_forms = False  # set by tests, which try them without a GPU
VECTOR = 32
# Powers of two fill the vectors; sizes far from 32 make more rows or longer products.
_BLOCKS = (VECTOR, 16, 40, 48, 24, 56, 28, 36, 20, 44, 52)
EXACT_IN_FLOAT32 = 2**23  # as exact as up to 2^24, and readable from the lowest bits


def on_platform(
    *operands: PyTree, cpu: Callable[..., PyTree], default: Callable[..., PyTree]
) -> PyTree:
    """The result of `cpu` on a CPU, and of `default` elsewhere.

    Both give the same numbers, up to rounding.
    """
    if _only_the_default_forms:
        return default(*operands)
    return jax.lax.platform_dependent(*operands, cpu=cpu, default=default)


def whole_blocks(n: int) -> int:
    """The length, n or more, that the blocks of a prefix sum divide."""
    size = block_size(n)
    return -(-n // size) * size


def block_size(n: int) -> int:
    """The length of the blocks of a prefix sum over n values."""
    # Operations fused with a padding, or a division by an odd size, are not vectorised.
    for size in _BLOCKS:
        if n % size == 0 and n > VECTOR:
            return size
    return VECTOR


def whole(values: Shaped[Array, " n"], fill: float) -> Shaped[Array, " p"]:
    """The values, filled up to whole blocks."""
    n = values.shape[0]
    return jnp.pad(values, (0, whole_blocks(n) - n), constant_values=fill)


@jax.custom_jvp
def stored(values: Shaped[Array, "*rest n"]) -> Shaped[Array, "*rest n"]:
    """The values, computed once and stored, where XLA on a CPU would not store them.

    XLA would compute them again wherever they are used: once for every particle, even if there is
    one for each component, and without vectors in a scatter or gather over flattened rows.
    """
    # In the blocks of the prefix sums, so that there is no division within the loop.
    *rest, n = values.shape
    size = block_size(n)
    blocks = values.reshape(*rest, -1, size) if n % size == 0 else values
    return apart(_same, blocks).reshape(values.shape)


def _same(values: Array) -> Array:
    return values


@stored.defjvp
def _stored_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    return stored(*primals), tangents[0]


def apart(function: Callable[..., PyTree], *operands: PyTree) -> PyTree:
    """`function(*operands)`, which XLA on a CPU compiles apart from what is around it.

    What is the same, operation by operation, is then compiled once.
    """
    function = jax.jit(function)  # so that it is traced once for both forms

    def call(*operands: PyTree) -> PyTree:
        if _MARKS_VALUES:
            return set_xla_metadata(function(*operands), inlineable="false")
        with set_xla_metadata(inlineable="false"):
            return function(*operands)

    return on_platform(*operands, cpu=call, default=function)


def take(values: Array, indices: Int[Array, " n"]) -> Array:
    """values[indices] for indices that are known to lie in range.

    Here and below they have no sign, so that JAX does not check whether they count from the end.
    """
    return values.at[indices.astype(jnp.uint32)].get(mode="promise_in_bounds")


def count_places(
    places: Int[Array, " n"], num_places: int, dtype: DTypeLike = jnp.int32
) -> Shaped[Array, " num_places"]:
    """How many of the entries name each place, all of which must be in [0, num_places)."""
    counts = jnp.zeros(num_places, dtype).at[places.astype(jnp.uint32)]
    return counts.add(1, mode="promise_in_bounds")


def along_rows(values: Shaped[Array, "*n"], rows: Shaped[Array, "..."]) -> Shaped[Array, "..."]:
    """The values of each row with further axes of length one, as many as the rows have."""
    return jnp.expand_dims(values, tuple(range(values.ndim, rows.ndim)))


def select_rows(is_new: Bool[Array, "*n"], new: PyTree, old: PyTree) -> PyTree:
    """The `new` rows of every leaf where they are chosen, and the `old` ones elsewhere."""

    def select(new: Array, old: Array) -> Array:
        return jnp.where(along_rows(is_new, new), new, old)

    return jax.tree.map(select, new, old)


def cond_if_any(
    is_needed: Bool[Array, ""], costly: Callable[[], PyTree], cheap: Callable[[], PyTree]
) -> PyTree:
    """`costly()` if any run of the caller's `vmap` needs it, `cheap()` otherwise.

    For a run that does not need it, `costly()` must give the result of `cheap()`.
    """
    return jax.lax.cond(any_run(is_needed), costly, cheap)


def drawn_once(key: Key[Array, "*num"], draw: Callable[..., PyTree]) -> PyTree:
    """`draw(key)`, computed once, where XLA would draw again in each operation that uses it.

    It is a branch that is always taken, which XLA cannot know: no word of a key has more bits than
    32. Unlike `stored`, this takes numbers of any kind, and NaN. Use it where draws are made once
    in a program and many operations use them: each would take part of a second to compile. Outside
    of a program it is `draw(key)` itself.
    """
    if not isinstance(key, Tracer):
        return draw(key)
    function = partial(draw, key)
    holds = any_run(jnp.all(jax.lax.population_count(jax.random.key_data(key)) <= 32))

    def nothing() -> PyTree:
        shapes = jax.eval_shape(function)
        return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)

    return jax.lax.cond(holds, function, nothing)


@jax.custom_batching.custom_vmap
def most_of_runs(number: Int[Array, ""]) -> Int[Array, ""]:
    """The largest of the numbers of the caller's `vmap`, the same for all its runs."""
    return number


@most_of_runs.def_vmap
def _most_of_many_runs(
    axis_size: int, in_batched: list[bool], numbers: Int[Array, " b"]
) -> tuple[Int[Array, ""], bool]:
    # A `vmap` around this one combines its own runs.
    return most_of_runs(jnp.max(numbers)), False


def any_run(is_needed: Bool[Array, ""]) -> Bool[Array, ""]:
    """Whether it is needed in any run of the caller's `vmap`, the same for all of them."""
    return most_of_runs(is_needed.astype(jnp.int32)) > 0
