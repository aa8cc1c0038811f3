"""The keys of a run: of its start, and of the moves of each step."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, Key, UInt32

from mpfjax.filter import Filter
from mpfjax.operations.random import fast_key, split, threefry


def initial_keys(key: Key[Array, ""], filter: Filter) -> Key[Array, " i"]:
    """The keys with which a run with this key draws and moves x_0."""
    return split(split(key, 2)[0], 1 + len(filter.initial_moves))


def split_for_run(
    key: Key[Array, ""], num_initial: int, num_steps: int, num_moves: int
) -> tuple[Key[Array, " i"], Key[Array, "t m"]]:
    """The keys of a run's start and of the moves of each step.

    `split(key, 2)` gives a key for the start, which is split into `num_initial`, and one for the
    steps, which is split into `num_steps`, and each of these into `num_moves`.
    """
    if fast_key(key) is key:
        key_initial, key_steps = split(key, 2)
        # Not by `vmap`, under which keys of some generators are split differently.
        moves = jax.lax.map(lambda key: split(key, num_moves), split(key_steps, num_steps))
        return split(key_initial, num_initial), moves
    # Key i of a split is the hash of i. One loop over the three generations compiles one hash.
    starts, index = jnp.arange(num_initial), jnp.arange(num_steps * num_moves)
    of_starts = jnp.stack([jnp.zeros_like(starts), starts, jnp.full_like(starts, -1)])
    of_moves = jnp.stack([jnp.ones_like(index), index // num_moves, index % num_moves])
    counters = jnp.concatenate([of_starts, of_moves], 1)[..., None]

    def next_generation(words: UInt32[Array, "e 2"], counter: Int[Array, "e 1"]) -> tuple:
        hashed = _both_halves(words[:, :1], words[:, 1:], counter.astype(jnp.uint32))
        return jnp.where(counter < 0, words, hashed), None  # a start has no third generation

    first = jnp.broadcast_to(jax.random.key_data(key), (counters.shape[1], 2))
    words, _ = jax.lax.scan(next_generation, first, counters)
    keys = jax.random.wrap_key_data(words, impl=jax.random.key_impl(key))
    return keys[:num_initial], keys[num_initial:].reshape(num_steps, num_moves)


def _both_halves(
    high_key: UInt32[Array, "*#n"], low_key: UInt32[Array, "*#n"], low: UInt32[Array, "n 1"]
) -> UInt32[Array, "n 2"]:
    """The hash of each counter (0, low).

    Each column hashes for itself and takes its half. If both were stacked, XLA would compile the
    rounds twice, and compute them as often.
    """
    columns = jnp.broadcast_to(low, (low.shape[0], 2))
    is_low = jax.lax.broadcasted_iota(jnp.uint32, columns.shape, 1) == 1
    high, low = threefry((high_key, low_key), jnp.zeros_like(columns), columns)
    return jnp.where(is_low, low, high)
