"""The fast generator draws what the stock one draws, bit for bit."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import erfinv, log_ndtr

import mpfjax
from mpfjax.operations.random import (
    below,
    bits,
    fast_key,
    normal,
    normal_quantile,
    split,
    threefry,
    uniform,
)
from tests.marking import quick_of

KEY = jax.random.key(7)
DRAWS = {
    "normal": lambda key: jax.random.normal(key, (1000,)),
    "uniform": lambda key: jax.random.uniform(key, (129,)),
    "short bits": lambda key: jax.random.bits(key, (100,), jnp.uint8),
    "gamma": lambda key: jax.random.gamma(key, 2.0, (200,)),
    "split": lambda key: jax.random.key_data(jax.random.split(key, 5)),
    "fold_in": lambda key: jax.random.key_data(jax.random.fold_in(key, 5)),
    "a split key": lambda key: jax.random.normal(jax.random.split(key)[1], (200,)),
}
QUICK = ("normal", "short bits", "gamma", "split", "a split key")


def same_keys(found, expected):
    assert found.dtype == expected.dtype
    np.testing.assert_array_equal(*map(jax.random.key_data, (found, expected)))


@pytest.mark.parametrize("name", quick_of(DRAWS, QUICK))
def test_the_same_bits_alone_and_under_jit_and_vmap(name):
    keys, draw = jax.random.split(KEY, 3), DRAWS[name]
    # Some versions of XLA round what gamma computes from the bits as they fuse it, or not.
    stock, rtol = jax.vmap(draw)(keys), 1e-6 * (name == "gamma")
    np.testing.assert_allclose(draw(fast_key(keys[1])), stock[1], rtol=rtol)
    fast = jax.jit(jax.vmap(lambda key: draw(fast_key(key))))
    np.testing.assert_allclose(fast(keys), stock, rtol=rtol)


@pytest.mark.parametrize("impl", ["threefry2x32", "rbg", "unsafe_rbg"])
def test_a_split_is_the_stock_one_alone_and_under_jit_and_vmap(impl):
    keys = jax.random.split(jax.random.key(3, impl=impl), 2)
    same_keys(split(keys[0], 7), jax.random.split(keys[0], 7))
    same_keys(jax.jit(split, static_argnums=1)(keys[0], 7), jax.random.split(keys[0], 7))
    each = (jax.vmap(partial(way, num=7))(keys) for way in (split, jax.random.split))
    same_keys(*each)


def test_other_settings_and_generators_are_left_alone():
    other = jax.random.key(0, impl="rbg")
    assert fast_key(other) is other
    with jax.threefry_partitionable(False):
        assert fast_key(KEY) is KEY


def test_the_published_answer():
    # Salmon et al. (2011), known answers of their reference implementation, 20 rounds.
    ones = jnp.full(2, 0xFFFFFFFF, jnp.uint32)
    high, low = threefry(ones, ones[:1], ones[:1])
    assert (int(high[0]), int(low[0])) == (0x1CB996FC, 0xBB002BE7)


class TestNormal:
    @pytest.mark.parametrize("shape", [(), (1000,), (70, 3), (40, 20)])
    def test_draws_what_jax_draws(self, shape):
        keys = jax.random.split(KEY, 3)
        expected = jax.vmap(lambda key: jax.random.normal(key, shape))(keys)
        np.testing.assert_allclose(normal(keys[0], shape), expected[0], rtol=5e-6, atol=1e-7)
        drawn = jax.jit(jax.vmap(lambda key: normal(fast_key(key), shape)))(keys)
        np.testing.assert_allclose(drawn, expected, rtol=5e-6, atol=1e-7)

    def test_quantiles_over_the_whole_range_of_a_uniform(self):
        # Every 2^9th of the uniforms that there are, and the last 2^9 at either end.
        index = np.concatenate(
            [np.arange(2**9), np.arange(0, 2**23, 2**9), np.arange(2**23 - 2**9, 2**23)]
        )
        lowest = np.nextafter(np.float32(-1), np.float32(0))
        uniforms = (index / 2**23 * 2).astype(np.float32) + lowest
        quantiles = np.asarray(normal_quantile(jnp.asarray(uniforms)), float)
        exact = np.sqrt(2) * erfinv(uniforms.astype(float))
        np.testing.assert_allclose(quantiles, exact, rtol=1e-6, atol=1e-7)
        tail = -np.abs(quantiles[:20])
        np.testing.assert_allclose(
            np.exp(log_ndtr(tail)), (1 - np.abs(uniforms[:20].astype(float))) / 2, rtol=2e-5
        )


class KeySpy(mpfjax.QuadraticModel):
    """A model that notes the generator of the keys that it is given."""

    def sample_transition(self, key, states):
        seen.append(str(jax.random.key_impl(key)))
        return super().sample_transition(key, states)


seen: list[str] = []


def test_whole_numbers_below_are_upper_halves_of_products():
    spans = np.repeat([1, 3, 10**6, 22_000_000, 2**30], 100)
    words = np.asarray(bits(KEY, spans.shape)).astype(np.uint64)
    found = below(KEY, jnp.asarray(spans, jnp.int32))
    np.testing.assert_array_equal(found, words * spans.astype(np.uint64) >> np.uint64(32))


@pytest.mark.exactness
def test_a_model_is_handed_ordinary_keys():
    """Which all of `jax.random` takes; the library wraps a key where it draws."""
    filter = mpfjax.particle_filter(KeySpy(), 64)
    mpfjax.run_filter(KEY, filter, jnp.ones(2), lambda mixture: mixture.mean())
    assert seen
    assert set(seen) == {"threefry2x32"}


@pytest.mark.exactness
def test_splits_and_draws_are_those_of_ordinary_keys():
    same_keys(split(KEY, 5), jax.random.split(KEY, 5))
    np.testing.assert_array_equal(uniform(KEY, (7,)), jax.random.uniform(KEY, (7,)))
    np.testing.assert_array_equal(bits(KEY, (7,)), jax.random.bits(KEY, (7,)))
