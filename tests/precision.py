"""Double precision for a stretch of a test."""

import jax


def float64():
    """A context in which new arrays are float64; JAX has moved it about over the versions."""
    if hasattr(jax, "enable_x64"):
        return jax.enable_x64(True)
    return jax.experimental.enable_x64()
