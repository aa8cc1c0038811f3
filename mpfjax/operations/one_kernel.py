"""A computation on a few numbers, compiled as one operation.

In numpy it is the function itself. XLA compiles a kernel for every few operations on a CPU, which
takes as long for four numbers as for a thousand.
"""

from collections.abc import Callable
from functools import partial

import jax
from jax.experimental.xla_metadata import set_xla_metadata
from jaxtyping import Array, ArrayLike, Shaped

from mpfjax.operations.gradients import without_gradient
from mpfjax.operations.platforms import on_platform
from mpfjax.operations.stored import stored

# Of more numbers, XLA cannot compile all pairs, or their sums, within one kernel.
_FEW = 16
# By these marks XLA emits a call as one kernel, as it does with its own small loops.
_AS_ONE_KERNEL = {"inlineable": "false", "xla_cpu_small_call": "true"}


def in_one_kernel(
    function: Callable[..., Shaped[Array, " m"]], *arguments: Array
) -> Shaped[Array, " m"]:
    """`stored(function(*arguments))`, on a CPU in one kernel where the arrays are short.

    The function may use pairs of their entries, and nothing but its arguments. A derivative treats
    the result as a constant. Under `vmap`, where the runs multiply the numbers, with more than 16
    and on other platforms it is compiled as usual. The numbers are the same.
    """

    def kept(*arguments: ArrayLike) -> Array:
        return stored(function(*arguments))

    arguments = without_gradient(arguments)
    if any(argument.size > _FEW for argument in arguments):
        return kept(*arguments)
    alone = jax.custom_batching.custom_vmap(
        lambda *arguments: on_platform(
            *arguments, cpu=partial(_marked, jax.jit(function)), default=kept
        )
    )

    @alone.def_vmap
    def _(axis_size: int, in_batched: list[bool], *arguments: ArrayLike) -> tuple[Array, bool]:
        del axis_size  # constants of the program are numpy's
        axes = [0 if is_batched else None for is_batched in in_batched]
        return jax.vmap(kept, axes)(*arguments), True

    return alone(*arguments)


def _marked(function: Callable[..., Array], *arguments: ArrayLike) -> Array:
    with set_xla_metadata(**_AS_ONE_KERNEL):
        return function(*arguments)
