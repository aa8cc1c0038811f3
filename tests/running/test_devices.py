"""Many devices and threads give the numbers of one; islands, and what they exchange."""

import os
import subprocess
import sys
import threading
from pathlib import Path

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
import mpfjax.running.run
from mpfjax.operations import compiling
from mpfjax.operations.compiling import cpu_options, in_little_memory
from mpfjax.operations.islands import DEVICE_AXIS, ISLAND_AXIS
from mpfjax.operations.segments import segment_sum
from mpfjax.running.devices import over_threads
from mpfjax.running.islands import IslandInteraction
from tests import on_devices
from tests.examples import AT_START, make_mixture
from tests.precision import float64
from tests.user_models import Window

REPOSITORY = Path(__file__).resolve().parents[2]
MODEL = on_devices.quadratic()
OBSERVATIONS = on_devices.observations()


def mean(mixture):
    return mixture.mean()


@pytest.mark.weekly
def test_eight_devices_give_the_numbers_of_one(tmp_path):
    """Those of a process of its own."""
    file = tmp_path / "eight.npz"
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=8"
    environment = {"PYTHONPATH": str(REPOSITORY), "JAX_PLATFORMS": "cpu", "XLA_FLAGS": flags}
    command = [sys.executable, "-m", "tests.on_devices", str(file)]
    subprocess.run(command, cwd=REPOSITORY, env=os.environ | environment, check=True, timeout=240)
    with float64(), jax.numpy_dtype_promotion("standard"):
        one = on_devices.leaves(replicates=on_devices.replicates(), islands=on_devices.islands())
    runs = dict(np.load(file))
    assert runs.keys() == one.keys()
    for name, leaf in one.items():
        np.testing.assert_allclose(runs[name], leaf, rtol=1e-9, atol=1e-9)


# --- islands -------------------------------------------------------------------------------------


class TestIslands:
    @pytest.mark.exactness
    def test_an_exchange_revives_islands_without_any_likelihood(self):
        """And a missing observation is skipped."""

        def mass(mixture):
            return mixture.log_mass

        model = Window(0.3, 0.5, -2.0, 2.0)
        for exchange in (IslandInteraction(0.0), IslandInteraction(1.0)):
            moves = [mpfjax.Resample(), mpfjax.Propagate(), exchange]
            run = mpfjax.run_islands(
                jax.random.key(6),
                mpfjax.Filter(model, moves, 8),
                mpfjax.Series.skipping(OBSERVATIONS.at[2].set(jnp.nan)),
                mass,
                num_islands=8,
            )
            assert np.isfinite(run.log_marginal_likelihood)
            assert run.log_likelihood_increments[2] == 0
            assert not any(np.isnan(leaf).any() for leaf in jax.tree.leaves(run))
            dead = np.asarray(run.collected) == -np.inf
            if exchange.threshold == 0:
                assert dead[0].any()
                assert (dead[1:] >= dead[:-1]).all()
        assert (dead[:-1] & ~dead[1:]).any()


class TestExchange:
    def exchanged(self, threshold, log_masses, n=24):
        """On islands that lie along the leading axis, two on a device."""
        rng = np.random.default_rng(0)
        g = len(log_masses)
        log_weights = rng.normal(size=(g, n)) + np.asarray(log_masses)[:, None]
        states, labels = rng.normal(size=g * n), rng.integers(0, 3, g * n)
        whole = make_mixture(states, log_weights.ravel(), labels, 3)

        def on_each(leaf):
            return leaf.reshape(2, -1, n, *leaf.shape[1:]) if leaf.ndim else jnp.full((2, 2), leaf)

        islands = jax.tree.map(on_each, whole)
        move = jax.vmap(
            lambda part: IslandInteraction(threshold)(jax.random.key(0), part, AT_START),
            axis_name=ISLAND_AXIS,
        )
        return islands, jax.vmap(move, axis_name=DEVICE_AXIS)(islands)

    @pytest.mark.exactness
    def test_deals_particle_i_to_island_i_and_keeps_every_one(self):
        before, after = self.exchanged(0.5, [0.0, -5.0, -20.0, -300.0])
        masses = np.exp(np.asarray(after.log_weights, float)).sum(axis=2)
        np.testing.assert_allclose(masses, 0.25, atol=0.15)
        for name in ("particles", "log_weights", "component_indicators", "ancestor_indices"):
            one, other = (np.asarray(getattr(m, name)).reshape(4, 24) for m in (before, after))
            for island in range(4):
                dealt = one[:, np.arange(24) % 4 == island].ravel()
                np.testing.assert_array_equal(np.sort(other[island]), np.sort(dealt))

    @pytest.mark.parametrize(
        ("threshold", "log_masses"), [(0.5, [0.0, 0.5, 0.0, 0.5]), (0.0, [0.0, -9.0, -9.0, -9.0])]
    )
    def test_does_nothing_while_masses_are_even_enough(self, threshold, log_masses):
        chex.assert_trees_all_equal(*self.exchanged(threshold, log_masses))


# --- threads -------------------------------------------------------------------------------------


def draw_with(keys, scale):
    return scale * jax.vmap(lambda key: jax.random.normal(key, (4,)))(keys)


class TestThreads:
    @pytest.mark.parametrize("num_threads", [2, 3, 20])
    def test_the_numbers_are_those_of_one_block(self, num_threads):
        keys = jax.random.split(jax.random.key(3), 7)
        drawn = over_threads(draw_with, keys, (2.0,), num_threads)
        np.testing.assert_array_equal(drawn, jax.jit(draw_with)(keys, 2.0))

    def test_blocks_run_at_the_same_time_and_compile_once(self):
        traced = []

        def note(drawn):
            threads.add(threading.get_ident())
            barrier.wait(60)
            return drawn

        def run(keys):
            traced.append(keys.shape)
            drawn = draw_with(keys, 1.0)
            return jax.pure_callback(note, jax.typeof(drawn), drawn)

        keys = jax.random.split(jax.random.key(4), 6)
        barrier, threads = threading.Barrier(1), set()  # the block that compiles runs by itself
        np.testing.assert_array_equal(over_threads(run, keys, (), 2), draw_with(keys, 1.0))
        barrier, threads = threading.Barrier(2), set()  # the blocks pass together or not at all
        np.testing.assert_array_equal(over_threads(run, keys, (), 2), draw_with(keys, 1.0))
        assert len(threads) == 2
        assert traced == [(3,)]

    @pytest.mark.exactness
    def test_settings_and_transformations_of_this_thread_hold(self):
        keys = jax.random.split(jax.random.key(5), 4)
        with float64():
            assert over_threads(draw_with, keys, (2.0,), 2).dtype == np.float64

        def total(scale):
            return jnp.sum(over_threads(draw_with, keys, (scale,), 2))

        np.testing.assert_allclose(jax.grad(total)(2.0), total(1.0), rtol=1e-5)
        np.testing.assert_allclose(jax.jit(total)(2.0), total(2.0), rtol=1e-5)

    @pytest.mark.exactness
    @pytest.mark.parametrize(
        "limits",
        [
            {"_WORTH_A_THREAD": 1, "num_processors": lambda: 3},
            {"_IN_CACHE": 100, "_IN_NEAR_CACHE": 80},
        ],
        ids=["on threads", "in groups"],
    )
    def test_a_study_has_the_runs_of_each_key(self, limits, monkeypatch):
        for name, value in limits.items():
            monkeypatch.setattr(mpfjax.running.run, name, value)
        keys = jax.random.split(jax.random.key(7), 6)
        filter = mpfjax.particle_filter(MODEL, 32)
        assert "_IN_CACHE" not in limits or mpfjax.running.run._group_size(6, filter) == 2
        # Another function is another program.
        runs = mpfjax.monte_carlo(keys, filter, OBSERVATIONS, lambda mixture: mixture.mean())
        for k in range(6):
            run = mpfjax.run_filter(keys[k], filter, OBSERVATIONS, mean)
            np.testing.assert_allclose(runs.collected[k], run.collected, rtol=1e-5)
            np.testing.assert_allclose(runs.final.particles[k], run.final.particles, rtol=1e-5)


# --- how programs are compiled -------------------------------------------------------------------


@pytest.fixture
def optimised(monkeypatch):
    """Compiled as outside of the tests."""
    setting = jax.config.read("jax_disable_most_optimizations")
    jax.config.update("jax_disable_most_optimizations", False)
    monkeypatch.setenv("XLA_FLAGS", "")
    yield
    jax.config.update("jax_disable_most_optimizations", setting)
    compiling._older_emitters.cache_clear()


SUMS = {"xla_disable_hlo_passes": "tree_reduction_rewriter"}
SUMS = SUMS if jax.__version_info__ >= (0, 10) else {}


def test_an_option_is_left_to_a_flag_that_sets_it(monkeypatch, optimised):
    assert cpu_options() == {"xla_cpu_prefer_vector_width": 512} | SUMS
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_prefer_vector_width=128")
    assert cpu_options() == SUMS


def test_little_memory_is_an_option_that_this_compiler_has_or_is_left_out(monkeypatch, optimised):
    compiling._older_emitters.cache_clear()
    assert jax.jit(lambda x: 3 * x, compiler_options=in_little_memory(soon=True))(3.0) == 9
    compiling._older_emitters.cache_clear()
    monkeypatch.setattr(compiling, "_FUSION_EMITTERS", "xla_cpu_has_no_such_option")
    assert in_little_memory() == SUMS


@pytest.mark.parametrize("n", [1000, 2**20])
def test_sums_of_many_numbers_stay_exact_with_the_options(n, optimised):
    """In one piece, but not one number after the other: that would be off by 1e-5 to 1e-3."""
    values = jnp.full(n, 0.1)
    every = jax.jit(lambda x: jnp.sum(jnp.where(x > 0, x, 0.0)), compiler_options=cpu_options())
    odd = jax.jit(lambda x: segment_sum(x, jnp.arange(n) % 2, 2)[1], compiler_options=cpu_options())
    exact = n * float(np.float32(0.1))
    np.testing.assert_allclose(every(values), exact, rtol=2e-6)
    np.testing.assert_allclose(odd(values), exact / 2, rtol=2e-6)
