"""Checkpoints go on to the bit, and files are whole or an error that names them."""

import errno
import io
import os
import struct
import zipfile
from concurrent.futures import ThreadPoolExecutor

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax.operations.random import fast_key
from mpfjax.running.storage import describe, load_arrays, write_arrays
from tests.examples import make_mixture
from tests.full_disk import no_room_beyond

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


class TestOnlineFilter:
    NUM_STEPS, BROKEN_OFF = 12, 5

    def go_on(self, filter, state):
        """To the end, with each step's report; broken off and resumed where there is a path."""
        infos = []
        for t in range(state["t"], self.NUM_STEPS):
            key, step_key = jax.random.split(state["key"])
            mixture, info = filter.step(step_key, state["mixture"], jnp.cos(0.3 * t) ** 2)
            state = {"mixture": mixture, "key": key, "t": t + 1}
            infos.append(info)
            if state["t"] == self.BROKEN_OFF:
                halfway = state
        return state, infos, halfway if len(infos) == self.NUM_STEPS else None

    def test_resumed_equals_uninterrupted_to_the_bit(self, path):
        regroup = [mpfjax.Merge(max_deviations=4.0, patience=3), mpfjax.Split(), mpfjax.KMeans(2)]
        model = mpfjax.QuadraticModel(0.1, 0.1, -2.5, 2.5)
        filter = mpfjax.mixture_particle_filter(model, 30, 3, regroup=regroup)
        start = {"mixture": filter.init(jax.random.key(0)), "key": jax.random.key(1), "t": 0}
        end, infos, halfway = self.go_on(filter, start)
        # Patience counts, so that what is resumed depends on the memory.
        assert np.asarray(halfway["mixture"].memory["overlap_durations"]).any()

        mpfjax.save_checkpoint(path, halfway)
        other = {"mixture": filter.init(jax.random.key(9)), "key": jax.random.key(9), "t": 0}
        restored = mpfjax.load_checkpoint(path, like=other)
        assert_same_bits(restored, halfway)
        resumed_end, resumed_infos, _ = self.go_on(filter, restored)
        assert_same_bits(resumed_end, end)
        assert_same_bits(resumed_infos, infos[self.BROKEN_OFF :])


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
            "half": jnp.array([1.5, -2.0], jnp.bfloat16),
            "nothing": jnp.zeros((0, 2)),
            "awkward": jnp.array([jnp.nan, -jnp.inf, -0.0]),
            "numpy": np.arange(3, dtype=np.int64),
            "scalar": np.float32(0.1),
            "file": (7, 0.1, True, None),
        }
        mpfjax.save_checkpoint(path, state)
        assert_same_bits(mpfjax.load_checkpoint(path, like=state), state)
        with np.load(path, allow_pickle=False) as file:
            assert file["['mixture'].memory['ages']"].tolist() == [0, 1]

    def test_shapes_alone_say_what_it_is_like(self, path):
        state = (MIXTURE, jax.random.key(0))
        mpfjax.save_checkpoint(path, state)
        assert_same_bits(mpfjax.load_checkpoint(path, jax.eval_shape(lambda: state)), state)

    def test_a_filter_with_a_network_comes_back(self, path):
        def network(seed):
            return eqx.nn.MLP(1, 2, 4, 1, key=jax.random.key(seed))

        mpfjax.save_checkpoint(path, network(0))
        assert_same_bits(
            eqx.filter(mpfjax.load_checkpoint(path, like=network(1)), eqx.is_array),
            eqx.filter(network(0), eqx.is_array),
        )
        tanh = eqx.nn.MLP(1, 2, 4, 1, jnp.tanh, key=jax.random.key(0))
        with pytest.raises(ValueError, match="activation"):
            mpfjax.load_checkpoint(path, like=tanh)


class TestOtherStates:
    @pytest.mark.parametrize(
        ("other", "named"),
        [
            (make_mixture([0, 0, 0], [0, 0, 0], [0, 0, 0], 3, MIXTURE.memory), "num_components"),
            (make_mixture([0, 0], [0, 0], [0, 0], 2, MIXTURE.memory), r"particles.*\[3\].*\[2\]"),
            (MIXTURE.replace(memory={}), "ages.* there and not here"),
            (MIXTURE.replace(memory=MIXTURE.memory | {"x": jnp.ones(1)}), "x.* is not there"),
            (MIXTURE.replace(particles=jnp.zeros(3, jnp.int32)), "particles.*float32.*int32"),
        ],
    )
    def test_are_refused_by_what_differs(self, path, other, named):
        mpfjax.save_checkpoint(path, MIXTURE)
        with pytest.raises(ValueError, match=f"like: .*checkpoint.npz holds another.*{named}"):
            mpfjax.load_checkpoint(path, like=other)

    def test_keys_of_another_generator_are_refused(self, path):
        mpfjax.save_checkpoint(path, jax.random.key(0))
        with pytest.raises(ValueError, match=r"key<fry>\[\] there and key<rbg>\[\] here"):
            mpfjax.load_checkpoint(path, like=jax.random.key(0, impl="rbg"))

    def test_arrays_that_are_no_checkpoint_are_refused(self, path):
        write_arrays(path, {"x": np.ones(2)})
        with pytest.raises(ValueError, match=r"checkpoint.npz: no checkpoint"):
            mpfjax.load_checkpoint(path, like=MIXTURE)


class TestFiles:
    def test_cut_off_anywhere_it_is_an_error_that_names_the_file(self, path):
        mpfjax.save_checkpoint(path, MIXTURE)
        whole = path.read_bytes()
        for length in [*range(0, len(whole), 97), len(whole) - 1]:
            path.write_bytes(whole[:length])
            with pytest.raises(ValueError, match=r"checkpoint.npz: cut off"):
                mpfjax.load_checkpoint(path, like=MIXTURE)

    def test_a_flipped_bit_of_an_array_is_noticed(self, path):
        write_arrays(path, {"x": np.full(100, 7.0)})
        content = bytearray(path.read_bytes())
        content[content.index(np.float64(7.0).tobytes()) + 3] ^= 1
        path.write_bytes(content)
        with pytest.raises(ValueError, match="cut off, damaged"):
            load_arrays(path)

    def test_one_array_of_numpy_is_no_archive(self, path):
        path.parent.mkdir()
        with path.open("wb") as file:
            np.save(file, np.ones(3))
        with pytest.raises(ValueError, match=r"checkpoint.npz: cut off, damaged or no .npz file"):
            load_arrays(path)

    @pytest.mark.parametrize("is_compressed", [False, True])
    def test_whichever_bit_flips_there_is_no_other_error(self, path, is_compressed):
        write_arrays(path, {"x": np.arange(3.0)})
        if is_compressed:
            np.savez_compressed(path, x=np.arange(3.0))
        whole, faults = path.read_bytes(), []
        for bit in range(8 * len(whole)):
            content = bytearray(whole)
            content[bit // 8] ^= 1 << bit % 8
            path.write_bytes(content)
            try:
                load_arrays(path)
            except ValueError as error:
                faults.append(str(error))
        assert faults
        assert all("cut off, damaged" in fault for fault in faults)

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

    def test_a_missing_file_is_named(self, path):
        with pytest.raises(FileNotFoundError, match=r"checkpoint.npz"):
            mpfjax.load_checkpoint(path, like=MIXTURE)

    def test_no_code_in_a_file_is_run(self, tmp_path):
        trace = tmp_path / "it ran"

        class Code:
            def __reduce__(self):
                return open, (str(trace), "w")

        np.savez(tmp_path / "code.npz", x=np.array([Code()], object))
        with pytest.raises(ValueError, match=r"code.npz"):
            load_arrays(tmp_path / "code.npz")
        assert not trace.exists()

    @pytest.mark.parametrize("array", [np.array([{}]), np.asarray(jnp.ones(2, jnp.bfloat16))])
    def test_arrays_that_would_not_load_are_not_written(self, path, array):
        with pytest.raises(ValueError, match=r"mine: .* does not load without pickles"):
            write_arrays(path, {"mine": array})
        assert not path.parent.exists()

    def test_they_equal_what_numpy_writes(self, tmp_path):
        arrays = {"a": np.arange(5), "b": np.array("text"), "c": np.ones((2, 0), bool)}
        write_arrays(tmp_path / "ours.npz", arrays)
        np.savez(tmp_path / "theirs.npz", **arrays)
        assert (tmp_path / "ours.npz").read_bytes() == (tmp_path / "theirs.npz").read_bytes()


def npy(shape, dtype="<f8", content=b""):
    """A .npy file with a header that claims this shape, and this content."""
    file = io.BytesIO()
    header = {"descr": dtype, "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(file, header)
    return file.getvalue() + content


def write_archive(path, members, compression=zipfile.ZIP_STORED):
    path.parent.mkdir(exist_ok=True)
    with zipfile.ZipFile(path, "w", compression) as archive:
        for name, content in members.items():
            archive.writestr(f"{name}.npy", content)


class TestHeadersThatLie:
    @pytest.mark.parametrize(
        "content",
        [
            npy((10**12,)),
            npy((10**30,)),
            npy((2, 10**30), content=bytes(16)),
            npy((10**9, 10**9, 10**9)),
            npy((3,), content=bytes(16)),
            npy((-1, -2), content=bytes(16)),
            npy((0, 10**30)),
            npy((1,), "|O", bytes(8)),
            b"\x93NUMPY\x01\x00" + struct.pack("<H", 9000) + b"-" * 8999 + b"1",
            b"\x93NUMPY\x09\x00" + bytes(100),
            b"",
        ],
        ids=range(11),
    )
    @pytest.mark.parametrize("compression", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
    def test_are_errors_that_name_the_file(self, path, content, compression):
        write_archive(path, {"x": content}, compression)
        with pytest.raises(ValueError, match=r"checkpoint.npz: cut off, damaged"):
            load_arrays(path)

    @pytest.mark.parametrize("order", ["C", "F"])
    def test_honest_ones_load_as_by_numpy_and_may_be_written_to(self, path, order):
        array = np.asarray(np.arange(12, dtype=">i4").reshape(3, 4), order=order)
        write_archive(path, {})
        np.savez_compressed(path, x=array, nothing=np.zeros((0, 3)), word=np.array("text"))
        loaded = load_arrays(path)
        for name, expected in np.load(path).items():
            assert loaded[name].dtype == expected.dtype
            np.testing.assert_array_equal(loaded[name], expected)
        loaded["x"][0, 0] = 7


STATE = {"x": jnp.arange(3.0), "key": jax.random.key(0), "t": 2, "half": jnp.ones(2, "bfloat16")}


class TestCheckpointsThatLie:
    def spoil(self, path, **changes):
        """A checkpoint of the state with some of its arrays changed or, by None, left out."""
        mpfjax.save_checkpoint(path, STATE)
        arrays = load_arrays(path)
        changed = {
            name if name == "description" else f"['{name}']": a for name, a in changes.items()
        }
        assert changed.keys() <= arrays.keys()
        arrays |= changed
        write_arrays(path, {name: array for name, array in arrays.items() if array is not None})

    @pytest.mark.parametrize("description", ["null", "{", '{"x": 1}'])
    def test_a_description_that_is_none_is_an_error_that_names_the_file(self, path, description):
        self.spoil(path, description=np.array(description))
        with pytest.raises(ValueError, match=r"checkpoint.npz"):
            mpfjax.load_checkpoint(path, like=STATE)

    @pytest.mark.parametrize("name", STATE)
    def test_a_missing_array_is_named(self, path, name):
        self.spoil(path, **{name: None})
        with pytest.raises(ValueError, match=rf"checkpoint.npz: .*\['{name}'\]"):
            mpfjax.load_checkpoint(path, like=STATE)

    @pytest.mark.parametrize(
        ("name", "array"),
        [
            ("x", np.arange(3.0)),
            ("x", np.array("abc")),
            ("key", np.zeros(3, np.uint32)),
            ("t", np.array([2, 3])),
            ("half", np.ones(2, np.float16)),
        ],
    )
    def test_an_array_that_is_not_as_described_is_named(self, path, name, array):
        self.spoil(path, **{name: array})
        with pytest.raises(ValueError, match=rf"checkpoint.npz: .*\['{name}'\]"):
            mpfjax.load_checkpoint(path, like=STATE)

    def test_numbers_of_any_size_come_back(self, path):
        state = {"small": -3, "large": 2**63, "complex": 1j, "yes": False}
        mpfjax.save_checkpoint(path, state)
        like = {"small": 0, "large": 0, "complex": 0j, "yes": True}
        assert describe(state) == describe(like)
        assert mpfjax.load_checkpoint(path, like) == state


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

    def test_noticed_only_when_the_disk_is_synced(self, path, monkeypatch):
        def full(_):
            raise OSError(errno.ENOSPC, "No space left on device")

        monkeypatch.setattr(os, "fsync", full)
        with pytest.raises(OSError, match="No space left on device; nothing") as info:
            mpfjax.save_checkpoint(path, MIXTURE)
        assert info.value.errno == errno.ENOSPC
        assert os.listdir(path.parent) == []
