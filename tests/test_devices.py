"""Many devices and processes give the numbers of one; islands, and what they exchange."""

import json
import os
import socket
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
from mpfjax.exact import grid_filter
from mpfjax.operations import compiling
from mpfjax.operations.compiling import cpu_options, in_little_memory
from mpfjax.operations.islands import (
    DEVICE_AXIS,
    ISLAND_AXIS,
    deal_to_islands,
    island_index,
    num_islands,
    over_islands,
)
from mpfjax.operations.segments import segment_sum
from mpfjax.running.devices import choose_devices, over_threads
from mpfjax.running.islands import IslandInteraction
from tests import on_devices
from tests.examples import make_mixture
from tests.marking import thorough
from tests.precision import float64
from tests.user_models import TrickyQuadraticModel

REPOSITORY = Path(__file__).resolve().parents[1]
NUM_ISLANDS = on_devices.NUM_ISLANDS


def start(*arguments, devices=1, program=("-m", "tests.on_devices")):
    count = f"--xla_force_host_platform_device_count={devices}"
    environment = os.environ | {
        "PYTHONPATH": str(REPOSITORY),
        "JAX_PLATFORMS": "cpu",
        "XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} {count}",
    }
    return subprocess.Popen(
        [sys.executable, *program, *map(str, arguments)],
        cwd=REPOSITORY,
        env=environment,
        stderr=subprocess.PIPE,
        text=True,
    )


def free_port():
    with socket.socket() as server:
        server.bind(("localhost", 0))
        return server.getsockname()[1]


def results_of(process, file):
    _, error = process.communicate(timeout=120)
    assert process.returncode == 0, error[-3000:]
    with np.load(file) as saved:
        runs = {name: saved[name] for name in saved.files if name != "told"}
        return runs, json.loads(str(saved["told"]))


@pytest.fixture(scope="module", autouse=True)
def processes(tmp_path_factory):
    """Eight devices in one process, and two processes of one device.

    They run while the tests that come first do.
    """
    folder, port = tmp_path_factory.mktemp("devices"), free_port()
    files = [folder / f"{name}.npz" for name in ("eight", "first", "second")]
    processes = [
        start(files[0], devices=8),
        start(files[1], port, 0),
        start(files[2], port, 1),
    ]
    yield dict(zip(files, processes, strict=True))
    for process in processes:
        process.kill()


@pytest.fixture(scope="module")
def started(processes):
    return {file.stem: results_of(process, file) for file, process in processes.items()}


@pytest.fixture(scope="module")
def on_one_device():
    with float64(), jax.numpy_dtype_promotion("standard"):
        return on_devices.leaves(replicates=on_devices.replicates(), islands=on_devices.islands())


MODEL = mpfjax.QuadraticModel(0.3, 0.5, -2.0, 2.0)
OBSERVATIONS = jnp.array(on_devices.OBSERVATIONS)


class Cliff(mpfjax.QuadraticModel):
    """Particles far from explaining the observation have no likelihood at all."""

    def log_likelihood(self, observation, states):
        near = jnp.abs(states**2 - observation) < 0.3
        return jnp.where(near, 0.0, -jnp.inf)


def mean(mixture):
    return mixture.mean()


def island_chains():
    resample, propagate = mpfjax.Resample(), mpfjax.Propagate(MODEL)
    adaptive = mpfjax.Resample("stratified", 0.5)
    seeded, regroup = [mpfjax.KMeans(2, reseed=True)], mpfjax.KMeans(2)
    return {
        "pf": mpfjax.Filter(MODEL, [resample, propagate], 12),
        "pf, exchange": mpfjax.Filter(MODEL, [IslandInteraction(), adaptive, propagate], 12),
        "mixture, exchange": mpfjax.Filter(
            MODEL, [resample, propagate, IslandInteraction(0.9), regroup], 12, 2, seeded
        ),
    }


class TestIslands:
    @pytest.mark.parametrize("chain", thorough(["mixture, exchange", "pf, exchange"]))
    def test_evidence_and_means_are_unbiased(self, chain):
        runs, keys = 1500, jax.random.split(jax.random.key(3), 1500)
        filter = island_chains()[chain]
        run = jax.vmap(
            lambda key: mpfjax.run_islands(key, filter, OBSERVATIONS, mean, num_islands=4)
        )(keys)
        exact = grid_filter(MODEL, OBSERVATIONS, jnp.linspace(-5.0, 5.0, 1001))
        log_ratios = np.cumsum(
            run.log_likelihood_increments - exact.log_likelihood_increments[None], axis=1
        )
        ratios = np.exp(log_ratios)
        means = ratios * np.asarray(run.collected.sum(axis=2))
        for estimates, truth in ((ratios, 1.0), (means, np.asarray(exact.means))):
            standard_error = estimates.std(axis=0) / np.sqrt(runs)
            assert (np.abs(estimates.mean(axis=0) - truth) < 4 * standard_error).all()

    @pytest.mark.thorough
    def test_one_island_is_a_run_of_the_filter(self):
        filter, key = island_chains()["pf, exchange"], jax.random.key(4)
        islands = mpfjax.run_islands(key, filter, OBSERVATIONS, num_islands=1)
        run = mpfjax.run_filter(jax.random.fold_in(key, 0), filter, OBSERVATIONS)
        chex.assert_trees_all_close(islands, run, rtol=1e-4, atol=1e-5)

    @pytest.mark.thorough
    def test_the_whole_is_one_normalised_mixture(self):
        filter = island_chains()["mixture, exchange"]
        run = mpfjax.run_islands(jax.random.key(5), filter, OBSERVATIONS, num_islands=4)
        assert run.resampled.shape == (4, 8)
        assert run.final.num_components == 8
        whole = run.collected
        assert whole.particles.shape == (4, 48)
        np.testing.assert_allclose(jnp.exp(whole.log_weights).sum(axis=1), 1.0, rtol=1e-5)
        home = np.asarray(whole.component_indicators) // 2
        np.testing.assert_array_equal(home, np.tile(np.repeat(np.arange(4), 12), (4, 1)))
        assert len(np.unique(whole.particles[0])) == 48
        # A child is no farther from its parent than the dynamics take it.
        ancestors = np.asarray(whole.ancestor_indices)
        parents = np.take_along_axis(np.asarray(whole.particles)[:-1], ancestors[1:], axis=1)
        assert np.abs(np.asarray(whole.particles)[1:] - parents).max() < 5 * 0.3
        assert (ancestors // 12 != home).any()

    @pytest.mark.thorough
    def test_islands_without_any_likelihood_die_and_an_exchange_revives_them(self):
        model = Cliff(0.3, 0.5, -2.0, 2.0)
        propagate = mpfjax.Propagate(model)

        def mass(mixture):
            return mixture.log_mass

        for before in ([], [IslandInteraction(1.0)]):
            filter = mpfjax.Filter(model, [*before, mpfjax.Resample(), propagate], 8)
            run = mpfjax.run_islands(jax.random.key(6), filter, OBSERVATIONS, mass, num_islands=8)
            assert np.isfinite(run.log_marginal_likelihood)
            dead = np.asarray(run.collected) == -np.inf
            assert dead[0].any()
            if not before:
                assert (dead[1:] >= dead[:-1]).all()
        assert not dead[-1].all()
        assert (dead[:-1] & ~dead[1:]).any()
        assert not any(np.isnan(leaf).any() for leaf in jax.tree.leaves(run))

    def test_missing_observations_and_broken_steps(self):
        filter = island_chains()["pf"]
        holed = OBSERVATIONS.at[1].set(jnp.nan)
        with pytest.raises(ValueError, match="index 1"):
            mpfjax.run_islands(jax.random.key(7), filter, holed, num_islands=2)
        run = mpfjax.run_islands(
            jax.random.key(7),
            filter,
            mpfjax.Series.skipping(holed.at[2].set(1e30)),
            mean,
            num_islands=2,
        )
        assert run.log_likelihood_increments[1] == 0
        np.testing.assert_array_equal(run.degenerate, [False, False, True, False])
        assert np.isfinite(run.collected).all()


def on_islands(function, values):
    """`function` on each of the islands that lie along the leading axis, two on a device."""
    inner = jax.vmap(function, axis_name=ISLAND_AXIS)
    outer = jax.vmap(inner, axis_name=DEVICE_AXIS)
    pairs = jax.tree.map(lambda leaf: leaf.reshape(-1, 2, *leaf.shape[1:]), values)
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), outer(pairs))


class TestTellingOtherIslands:
    def test_each_knows_its_place_and_hears_all_in_order(self):
        heard = on_islands(
            lambda value: (over_islands(value), island_index(), jnp.full((), num_islands())),
            jnp.arange(6.0),
        )
        np.testing.assert_array_equal(heard[0], np.tile(np.arange(6.0), (6, 1)))
        np.testing.assert_array_equal(heard[1], np.arange(6))
        np.testing.assert_array_equal(heard[2], 6)
        assert num_islands() == 1

    def test_row_i_is_dealt_to_island_i(self):
        rows = np.arange(4 * 12 * 2).reshape(4, 12, 2)
        dealt = np.asarray(on_islands(deal_to_islands, jnp.asarray(rows)))
        for island in range(4):
            expected = rows[:, np.arange(12) % 4 == island].reshape(-1, 2)
            np.testing.assert_array_equal(np.sort(dealt[island], axis=0), expected)


class TestExchange:
    def exchanged(self, threshold, log_masses, n=24):
        rng = np.random.default_rng(0)
        g = len(log_masses)
        log_weights = rng.normal(size=(g, n)) + np.asarray(log_masses)[:, None]
        states, labels = rng.normal(size=g * n), rng.integers(0, 3, g * n)
        whole = make_mixture(states, log_weights.ravel(), labels, 3)

        def on_each(leaf):
            return leaf.reshape(g, n, *leaf.shape[1:]) if leaf.ndim else jnp.repeat(leaf, g)

        islands = jax.tree.map(on_each, whole)
        move = IslandInteraction(threshold)
        return islands, on_islands(lambda part: move(jax.random.key(0), part), islands)

    def test_evens_the_masses_and_keeps_every_particle(self):
        before, after = self.exchanged(0.5, [0.0, -5.0, -20.0, -300.0])
        masses = np.exp(np.asarray(after.log_weights, float)).sum(axis=1)
        np.testing.assert_allclose(masses, 0.25, atol=0.15)
        fields = ("particles", "log_weights", "component_indicators", "ancestor_indices")
        one, other = (
            np.stack([np.asarray(getattr(m, name)).ravel() for name in fields], axis=1)
            for m in (before, after)
        )
        np.testing.assert_array_equal(other[np.argsort(other[:, 3])], one)

    @pytest.mark.parametrize(
        ("threshold", "log_masses"), [(0.5, [0.0, 0.5, 0.0, 0.5]), (0.0, [0.0, -9.0, -9.0, -9.0])]
    )
    def test_does_nothing_while_masses_are_even_enough(self, threshold, log_masses):
        before, after = self.exchanged(threshold, log_masses)
        chex.assert_trees_all_equal(before, after)

    def test_outside_islands_does_nothing(self):
        mixture = make_mixture(np.zeros(5), np.zeros(5), np.zeros(5), 1)
        assert IslandInteraction()(jax.random.key(0), mixture) is mixture

    def test_slots_that_cannot_be_dealt_evenly(self):
        filter = mpfjax.Filter(MODEL, [IslandInteraction(), mpfjax.Propagate(MODEL)], 13)
        with pytest.raises(ValueError, match=r"num_particles: 13 of an island .* 2 islands"):
            mpfjax.run_islands(jax.random.key(0), filter, OBSERVATIONS, num_islands=2)


class TestProcesses:
    @pytest.mark.parametrize("which", thorough(["first", "second"]))
    def test_must_all_pass_the_same_and_take_part(self, started, which):
        told = started[which][1]
        assert "keys, filter, observations: not the same in every process" in told["other keys"]
        assert "leaves 1 of the processes without any" in told["left out"]


@pytest.mark.thorough
@pytest.mark.parametrize("which", ["eight", "first", "second"])
class TestManyDevices:
    def test_they_take_part(self, started, which):
        assert started[which][1]["devices"] == (8 if which == "eight" else 2)

    @pytest.mark.parametrize("kind", ["replicates", "islands"])
    def test_give_the_numbers_of_one(self, started, on_one_device, which, kind):
        runs = started[which][0]
        assert runs.keys() == on_one_device.keys()
        names = [name for name in runs if name.startswith(kind)]
        assert len(names) > 8
        for name in names:
            np.testing.assert_allclose(runs[name], on_one_device[name], rtol=1e-9, atol=1e-9)


@pytest.mark.thorough
class TestTheCompiledProgram:
    """Of islands of 256 particles in two components each, on eight devices."""

    def test_sends_four_numbers_an_island_a_step_and_no_more(self, started):
        """Three parts of its mass, at once, and its mass, for whether an exchange is due."""
        everywhere = [c[:2] for c in started["eight"][1]["collectives"] if not c[2]]
        gathered = [["all-gather", NUM_ISLANDS], ["all-gather", 3 * NUM_ISLANDS]]
        assert sorted(everywhere) == gathered

    def test_sends_particles_in_the_branch_that_exchanges_them(self, started):
        """Every slot's state, weight, label and ancestor."""
        in_branch = [c[:2] for c in started["eight"][1]["collectives"] if c[2]]
        assert in_branch == [["all-to-all", 256]] * 4


class TestThreads:
    @pytest.mark.parametrize("num_threads", [2, 3, 7, 20])
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

    def test_settings_and_transformations_of_this_thread_hold(self):
        keys = jax.random.split(jax.random.key(5), 4)
        with float64():
            assert over_threads(draw_with, keys, (2.0,), 2).dtype == np.float64

        def total(scale):
            return jnp.sum(over_threads(draw_with, keys, (scale,), 2))

        np.testing.assert_allclose(jax.grad(total)(2.0), total(1.0), rtol=1e-5)
        np.testing.assert_allclose(jax.jit(total)(2.0), total(2.0), rtol=1e-5)
        np.testing.assert_allclose(jax.jit(lambda: total(3.0))(), total(3.0), rtol=1e-5)

    def test_an_error_is_raised_here(self):
        def fail(keys):
            raise ValueError(f"{keys.shape[0]} of them")

        with pytest.raises(ValueError, match="2 of them"):
            over_threads(fail, jax.random.split(jax.random.key(6), 4), (), 2)

    def test_a_study_on_threads_is_that_of_each_key(self, monkeypatch):
        monkeypatch.setattr(mpfjax.running.run, "_WORTH_A_THREAD", 1)
        monkeypatch.setattr(mpfjax.running.run, "num_processors", lambda: 3)
        keys = jax.random.split(jax.random.key(7), 5)
        filter = mpfjax.particle_filter(mpfjax.QuadraticModel(0.3, 0.5, -2.0, 2.0), 32)
        mean = mpfjax.ParticleMixture.mean
        runs = mpfjax.monte_carlo(keys, filter, OBSERVATIONS, mean)
        for k in range(5):
            run = mpfjax.run_filter(keys[k], filter, OBSERVATIONS, mean)
            np.testing.assert_allclose(runs.collected[k], run.collected, rtol=1e-5)
            np.testing.assert_allclose(runs.final.particles[k], run.final.particles, rtol=1e-5)


def draw_with(keys, scale):
    return scale * jax.vmap(lambda key: jax.random.normal(key, (4,)))(keys)


@pytest.fixture
def optimised():
    """Compiled as outside of the tests."""
    setting = jax.config.read("jax_disable_most_optimizations")
    jax.config.update("jax_disable_most_optimizations", False)
    yield
    jax.config.update("jax_disable_most_optimizations", setting)


def test_an_option_is_left_to_a_flag_that_sets_it(monkeypatch, optimised):
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=false")
    sums = {"xla_disable_hlo_passes": "tree_reduction_rewriter"}
    sums = sums if jax.__version_info__ >= (0, 10) else {}
    assert cpu_options() == {"xla_cpu_prefer_vector_width": 512} | sums
    assert cpu_options(soon=True) == cpu_options() | {"xla_backend_optimization_level": 1}
    passes = {"xla_disable_hlo_passes": ",".join([*sums.values(), "cpu-parallel-task-assigner"])}
    assert cpu_options(one_thread=True) == cpu_options() | passes
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_prefer_vector_width=128")
    assert cpu_options() == sums
    monkeypatch.setenv("XLA_FLAGS", "--xla_disable_hlo_passes=dce")
    assert cpu_options() == {"xla_cpu_prefer_vector_width": 512}
    monkeypatch.setenv("XLA_FLAGS", "")
    jax.config.update("jax_disable_most_optimizations", True)
    assert cpu_options() == cpu_options(soon=True) == {"xla_cpu_prefer_vector_width": 512}


@pytest.mark.parametrize("n", [1000, 4000, 2**20])
def test_sums_of_many_numbers_stay_exact_with_the_options(n, optimised):
    """In one piece, but not one number after the other: that would be off by 1e-5 to 1e-3."""
    values = jnp.full(n, 0.1)
    every = jax.jit(lambda x: jnp.sum(jnp.where(x > 0, x, 0.0)), compiler_options=cpu_options())
    odd = jax.jit(lambda x: segment_sum(x, jnp.arange(n) % 2, 2)[1], compiler_options=cpu_options())
    exact = n * float(np.float32(0.1))
    np.testing.assert_allclose(every(values), exact, rtol=2e-6)
    np.testing.assert_allclose(odd(values), exact / 2, rtol=2e-6)


def test_little_memory_is_an_option_that_this_compiler_has_or_is_left_out(monkeypatch, optimised):
    compiling._older_emitters.cache_clear()
    monkeypatch.setenv("XLA_FLAGS", "")
    sums = {"xla_disable_hlo_passes": "tree_reduction_rewriter"}
    sums = sums if jax.__version_info__ >= (0, 10) else {}
    options = in_little_memory()
    assert set(options) <= {"xla_cpu_use_fusion_emitters", *sums}
    assert in_little_memory(soon=True) == options | {"xla_backend_optimization_level": 1}
    assert jax.jit(lambda x: 3 * x, compiler_options=in_little_memory(soon=True))(3.0) == 9
    assert jax.jit(lambda x: 2 * x, compiler_options=options)(3.0) == 6
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_use_fusion_emitters=true")
    assert in_little_memory() == sums
    monkeypatch.setenv("XLA_FLAGS", "")
    compiling._older_emitters.cache_clear()
    monkeypatch.setattr(compiling, "_FUSION_EMITTERS", "xla_cpu_has_no_such_option")
    assert in_little_memory() == sums
    compiling._older_emitters.cache_clear()
    jax.config.update("jax_disable_most_optimizations", True)
    assert set(in_little_memory(soon=True)) <= {"xla_cpu_use_fusion_emitters"}


class TestChoosingDevices:
    def test_more_than_there_are(self, started):
        assert started["eight"][1]["too many"] == "devices: 9 asked for, and there are 8"
        with pytest.raises(ValueError, match="devices: 2 asked for, and there are 1"):
            on_devices.islands(2)

    def test_one_twice(self, started):
        assert "names one twice" in started["eight"][1]["twice"]

    def test_islands_that_cannot_be_dealt_evenly(self, started):
        assert "cannot be dealt evenly to 3 devices" in started["eight"][1]["uneven"]

    def test_a_given_one_is_the_one_that_runs(self, started):
        assert started["eight"][1]["only device"]

    def test_the_default_device_is_the_only_one(self):
        with jax.default_device(jax.devices()[0]):
            assert choose_devices(None) == jax.devices()[:1]


@pytest.mark.parametrize("num_components", thorough([3, 6]))
def test_a_constant_moves_the_evidence_of_islands_and_nothing_else(num_components):
    """Every island has a scale of its own, beside which none may be rounded away."""

    def run(constant, taken_off):
        model = TrickyQuadraticModel(0.3, 0.5, constant=constant, taken_off=taken_off)
        moves = [
            IslandInteraction(0.9),
            mpfjax.Resample(),
            mpfjax.Propagate(model),
            mpfjax.KMeans(2),
        ]
        filter = mpfjax.Filter(model, moves, 32, num_components, [mpfjax.KMeans(2, reseed=True)])
        return mpfjax.run_islands(
            jax.random.key(1), filter, jnp.array([1.5, 1.0, 0.4]), num_islands=4
        )

    for constant in map(np.float32, (1e3, -1e6, 1e9, -1e30)):
        with_it, without = run(constant, np.float32(0)), run(constant, constant)
        assert float(with_it.final.weights.sum()) == pytest.approx(1, rel=1e-5)
        np.testing.assert_allclose(with_it.final.weights, without.final.weights, atol=1e-7)
        increments = without.log_likelihood_increments + constant
        np.testing.assert_allclose(with_it.log_likelihood_increments, increments, rtol=1e-6)
