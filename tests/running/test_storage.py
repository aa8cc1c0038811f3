"""Checkpoints go on to the bit, and files are whole or an error that names them."""

import contextlib
import errno
import os
import resource
from concurrent.futures import ThreadPoolExecutor

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax.operations.random import fast_key
from mpfjax.running.long_runs import Broken, Checkpoint, LongRun, State
from mpfjax.running.storage import read_described, write_described
from tests.examples import make_mixture


@contextlib.contextmanager
def no_room_beyond(num_bytes):
    """A disk that is full, as the system reports it: every write beyond this length fails."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (num_bytes, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


MIXTURE = make_mixture([0.1, 0.2, 0.7], [0.0, 1.0, 2.0], [0, 1, 1], 2, {"ages": jnp.arange(2)})


def assert_same_bits(one, two):
    assert jax.tree.structure(one) == jax.tree.structure(two)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(two), strict=True):
        assert type(a) is type(b)
        if isinstance(a, jax.Array) and jax.dtypes.issubdtype(a.dtype, jax.dtypes.prng_key):
            assert a.dtype == b.dtype
            a, b = jax.random.key_data(a), jax.random.key_data(b)
        a, b = np.asarray(a), np.asarray(b)
        assert (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes())


@pytest.fixture
def path(tmp_path):
    return tmp_path / "new" / "checkpoint.npz"


class TestRoundTrip:
    @pytest.mark.parametrize(
        "key",
        [jax.random.key(3), jax.random.key(3, impl="rbg"), fast_key(jax.random.key(3))],
        ids=lambda key: str(key.dtype),
    )
    def test_every_kind_of_leaf_comes_back(self, path, key):
        state = {
            "mixture": MIXTURE,
            "keys": jax.random.split(key, 2),
            "half": jnp.array([1.5, -2.0], jnp.float16),
            "awkward": jnp.array([jnp.nan, -jnp.inf, -0.0]),
            "numpy": (np.arange(3, dtype=np.int64), np.float32(0.1), np.zeros((0, 2))),
            "python": (7, 0.1, True, None, 2**63, 1j),
        }
        mpfjax.save_checkpoint(path, state)
        assert_same_bits(mpfjax.load_checkpoint(path, like=state), state)
        shapes = jax.eval_shape(lambda: (MIXTURE, key))
        mpfjax.save_checkpoint(path, (MIXTURE, key))
        assert_same_bits(mpfjax.load_checkpoint(path, shapes), (MIXTURE, key))
        with np.load(path, allow_pickle=False) as file:
            assert file["[0].memory['ages']"].tolist() == [0, 1]

    def test_a_network_comes_back(self, path):
        def network(seed, activation=jax.nn.relu):
            return eqx.nn.MLP(1, 2, 4, 1, activation, key=jax.random.key(seed))

        mpfjax.save_checkpoint(path, network(0))
        back = mpfjax.load_checkpoint(path, like=network(1))
        assert_same_bits(eqx.filter(back, eqx.is_array), eqx.filter(network(0), eqx.is_array))
        with pytest.raises(ValueError, match="activation"):
            mpfjax.load_checkpoint(path, like=network(0, jnp.tanh))

    @pytest.mark.parametrize(
        ("other", "named"),
        [
            (make_mixture([0, 0, 0], [0, 0, 0], [0, 0, 0], 3, MIXTURE.memory), "num_components"),
            (make_mixture([0, 0], [0, 0], [0, 0], 2, MIXTURE.memory), r"particles.*\[3\].*\[2\]"),
            (MIXTURE.replace(memory={}), "ages.* there and not here"),
            (MIXTURE.replace(memory=MIXTURE.memory | {"x": jnp.ones(1)}), "x.* is not there"),
            (MIXTURE.replace(particles=jnp.zeros(3, jnp.int32)), "particles.*float32.*int32"),
            (jax.random.key(0, impl="rbg"), r"key<rbg>\[\] here"),
        ],
    )
    def test_another_state_is_refused_by_what_differs(self, path, other, named):
        mpfjax.save_checkpoint(path, MIXTURE if "key" not in named else jax.random.key(0))
        with pytest.raises(ValueError, match=f"like: .*checkpoint.npz contains another.*{named}"):
            mpfjax.load_checkpoint(path, like=other)


class TestFiles:
    @pytest.mark.exactness
    def test_a_file_that_is_cut_off_or_has_a_flipped_bit_loads_as_it_was_or_not_at_all(self, path):
        write_described(path, {"x": np.arange(3.0)}, {})
        stored = path.read_bytes()
        np.savez_compressed(path, x=np.arange(3.0), description="{}")
        faults = []
        for whole in (stored, path.read_bytes()):
            spoilt = [whole[:length] for length in range(0, len(whole), 7)]
            for bit in range(0, 8 * len(whole), 9):
                content = bytearray(whole)
                content[bit // 8] ^= 1 << bit % 8
                spoilt.append(content)
            for content in spoilt:
                path.write_bytes(content)
                try:
                    np.testing.assert_equal(read_described(path), ({"x": np.arange(3.0)}, {}))
                except ValueError as error:
                    faults.append(str(error))
        assert len(faults) > 100
        assert all("checkpoint.npz: cut off, damaged" in fault for fault in faults)

    def test_several_writers_of_one_path_leave_a_whole_file(self, path):
        """And whoever reads it meanwhile finds one that is whole."""
        states = [np.full(1000, writer) for writer in range(4)]
        mpfjax.save_checkpoint(path, states[0])

        def write_and_read(state):
            for _ in range(20):
                mpfjax.save_checkpoint(path, state)
                assert len(set(mpfjax.load_checkpoint(path, like=state))) == 1

        with ThreadPoolExecutor(len(states)) as writers:
            list(writers.map(write_and_read, states))
        assert list(path.parent.iterdir()) == [path]

    def test_no_code_in_a_file_is_run_and_none_is_written(self, path, tmp_path):
        trace = tmp_path / "it ran"

        class Code:
            def __reduce__(self):
                return open, (str(trace), "w")

        for array in (np.array([Code()], object), np.asarray(jnp.ones(2, jnp.bfloat16))):
            with pytest.raises(ValueError, match=r"mine: .* does not load without pickles"):
                write_described(path, {"mine": array}, {})
        assert not path.parent.exists()
        np.savez(tmp_path / "code.npz", x=np.array([Code()], object))
        with pytest.raises(ValueError, match=r"code.npz"):
            read_described(tmp_path / "code.npz")
        assert not trace.exists()

    @pytest.mark.parametrize(
        ("name", "array"),
        [
            ("description", None),
            ("description", np.array("{")),
            ("['x']", None),
            ("['x']", np.arange(3.0)),
            ("['key']", np.zeros(3, np.uint32)),
            ("['t']", np.array([2, 3])),
            ("['half']", np.ones(2, np.float32)),
        ],
    )
    def test_a_checkpoint_that_lies_is_an_error_that_names_what(self, path, name, array):
        state = {"x": jnp.arange(3.0), "key": jax.random.key(0), "t": 2}
        state |= {"half": jnp.ones(2, "float16")}
        mpfjax.save_checkpoint(path, state)
        arrays = {**np.load(path), name: array}
        np.savez(path, **{name: array for name, array in arrays.items() if array is not None})
        with pytest.raises(ValueError, match=r"checkpoint.npz: ") as info:
            mpfjax.load_checkpoint(path, like=state)
        assert name in str(info.value) or "descri" in str(info.value)


class TestFullDisk:
    def test_leaves_the_checkpoint_that_was_there(self, path):
        mpfjax.save_checkpoint(path, MIXTURE)
        before = path.read_bytes()
        for room in (0, 100, len(before) // 2, len(before) - 1):
            fault = pytest.raises(OSError, match=r"nothing that was written.*checkpoint.npz")
            with fault as info, no_room_beyond(room):
                mpfjax.save_checkpoint(path, MIXTURE)
            assert info.value.errno == errno.EFBIG
            assert path.read_bytes() == before
            assert os.listdir(path.parent) == [path.name]


class TestLongRuns:
    """The loop that `fit`, `maximise` and the samplers share, on a sum of 1, 2, ..."""

    def go(self, path, last, stop=None, error=None, **settings):
        """The rows and what stopped it; `error` comes where a step beyond `stop` is asked for."""
        checkpoint = None if path is None else Checkpoint(path, 3)
        settings = {"start": 0} | settings
        run = LongRun("adding", last, checkpoint, False, lambda step: settings)
        start = State(0, np.array(0), np.zeros(0, int))

        def advance(step, last, total):
            if step == stop:
                raise error
            return step + 1, total + step + 1, total[None] + step + 1

        state, stopped = run.go(start, advance)
        assert state.step == len(state.rows)
        return state.rows.tolist(), stopped

    def test_goes_on_as_if_it_had_not_been_broken_off(self, path):
        whole = np.cumsum(np.arange(1, 9)).tolist()
        assert self.go(None, 8) == self.go(path, 8) == (whole, None)
        path.unlink()
        with pytest.warns(UserWarning, match="adding: interrupted at step 5 of 8"):
            assert self.go(path, 8, 5, KeyboardInterrupt())[0] == whole[:5]
        with pytest.warns(UserWarning, match="it was nan at step 7; its result is of"):
            assert self.go(path, 8, 7, Broken("it was nan"))[0] == whole[:7]
        assert self.go(path, 8, 6, RuntimeError("step 6 again")) == (whole, None)
        assert self.go(path, 9) == ([*whole, 45], None)

    def test_a_kill_goes_back_to_the_last_checkpoint(self, path, monkeypatch):
        """The file is written after each third step; what comes later is lost with the process."""
        self.go(path, 3)
        third = path.read_bytes()
        with pytest.raises(MemoryError):
            self.go(path, 8, 4, MemoryError())
        assert path.read_bytes() != third  # an error that Python raises loses nothing
        path.write_bytes(third)
        assert self.go(path, 8) == self.go(None, 8)

    def test_what_is_broken_at_the_start_or_of_another_run_is_an_error(self, path):
        with pytest.raises(RuntimeError, match="adding: it was nan at the start"):
            self.go(path, 8, 0, Broken("it was nan"))
        with pytest.raises(KeyboardInterrupt):
            self.go(path, 8, 0, KeyboardInterrupt())
        self.go(path, 3)
        with pytest.raises(ValueError, match=r"checkpoint: .* is of another adding: start is 0"):
            self.go(path, 3, start=1)
        mpfjax.save_checkpoint(path, MIXTURE)
        with pytest.raises(ValueError, match=r"of another adding: caller is not there and adding"):
            self.go(path, 3)
        with pytest.raises(ValueError, match="every: 0"):
            Checkpoint(path, 0)
