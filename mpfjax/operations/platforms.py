"""The form of an operation that suits the platform: one for CPUs, one for all others."""

import contextlib
from collections.abc import Callable, Iterator

import jax
from jaxtyping import PyTree

_only_the_default_forms = False


def on_platform(
    *operands: PyTree, cpu: Callable[..., PyTree], default: Callable[..., PyTree]
) -> PyTree:
    """The result of `cpu` on a CPU, and of `default` elsewhere.

    Both give the same numbers, up to rounding.
    """
    if _only_the_default_forms:
        return default(*operands)
    return jax.lax.platform_dependent(*operands, cpu=cpu, default=default)


@contextlib.contextmanager
def default_forms() -> Iterator[None]:
    """Within it the default forms run on a CPU as well, so that they can be tried without a GPU."""
    global _only_the_default_forms
    _only_the_default_forms = True
    jax.clear_caches()
    try:
        yield
    finally:
        _only_the_default_forms = False
        jax.clear_caches()
