"""The benchmark of masses: its scenes, its errors, and a run with little of everything."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.masses import __main__ as command
from benchmarks.masses import bearings, corridor, measure
from benchmarks.masses.filters import FILTERS
from benchmarks.masses.scenes import SCENES, masses
from tests.marking import thorough

_LAWS = ["bearings", *thorough(["corridor", "mirror", "terrain", "jumps"])]


def test_what_the_arrays_hear_has_no_sign():
    motion = jnp.array([[3.0, 4.0, 0.0, 0.0], [3.0, -4.0, 0.0, 0.0], [-1.0, 0.0, 0.0, 0.0]])
    heard = np.asarray(bearings.heard(motion))
    np.testing.assert_allclose(heard[0], [np.arctan2(4, 3), np.arctan2(4, 3), np.pi], rtol=1e-5)
    # The second axis is turned by a little, and its mirror images with it.
    above, below = np.arctan2(4, -7) - bearings.AXES[1], np.arctan2(4, -7) + bearings.AXES[1]
    np.testing.assert_allclose(heard[1, :2], [above, below], rtol=1e-5)


def test_the_doors_of_the_corridor_look_alike():
    model = corridor.Corridor()
    states = jnp.array([1.3, 11.3, 21.3, 31.3, 41.3])
    seen = np.asarray(model.distance(states))
    np.testing.assert_allclose(seen, seen[0], rtol=1e-4)
    assert list(np.asarray(corridor.section(model, states, jnp.float32(1.3)))) == [0, 1, 2, 3, 0]


@pytest.mark.parametrize("name", _LAWS)
def test_noise_and_draws_have_one_law(name):
    """Of x_0 and of a step: the draws of the model and those from noise, by their moments."""
    make, _ = SCENES[name]
    model = make(2, 0).model
    keys = jax.random.split(jax.random.key(0), 4)
    n = 20_000
    start = model.sample_initial(keys[0], n)
    pairs = [(start, model.initial_from_noise(
        jax.random.normal(keys[1], (n, model.initial_noise_dimension))))]  # fmt: skip
    pairs.append((
        model.sample_transition(keys[2], start),
        model.transition_from_noise(jax.random.normal(keys[3], (n, model.noise_dimension)), start),
    ))  # fmt: skip
    for drawn, made in pairs:
        for one, other in zip(jax.tree.leaves(drawn), jax.tree.leaves(made), strict=True):
            one, other = np.asarray(one, float), np.asarray(other, float)
            error = np.sqrt((one.var(axis=0) + other.var(axis=0)) / n)
            assert (np.abs(one.mean(axis=0) - other.mean(axis=0)) <= 4 * error + 1e-9).all()
            np.testing.assert_allclose(one.std(axis=0), other.std(axis=0), rtol=0.05, atol=1e-9)


def test_errors_are_those_of_the_numbers():
    found = np.array([[0.5, 0.5], [1.0, 0.0]])
    known = measure.Known(np.array([0.5, 0.5]), np.zeros(2), 2.0, 0.0)
    entry = measure.summary(measure.Found(found, np.array([1.0, 4.0])), known, 1)
    assert entry["mass_rmse"] == pytest.approx(np.sqrt(0.125))
    assert entry["log_z_sd"] == pytest.approx(np.sqrt(4.5))
    assert entry["log_z_rmse"] == pytest.approx(np.sqrt(2.5))
    assert entry["lost"] == 0.5
    assert entry["mass_of_truth"] == 0.25
    assert entry["largest_mass"] == pytest.approx(0.75)


def test_a_filter_is_set_beside_the_first_by_paired_differences():
    """Of two runs: squared errors of log Z that differ by 1 and 3 have a mean of 2 ± 1."""
    known = measure.Known(np.array([0.5, 0.5]), np.zeros(2), 0.0, 0.0)
    masses_of_runs = np.array([[0.5, 0.5], [1.0, 0.0]])
    first = measure.Found(masses_of_runs, np.sqrt([1.0, 4.0]))
    other = measure.Found(masses_of_runs[::-1], np.sqrt([2.0, 7.0]))
    found = measure.worse(other, first, known, 1)
    assert found["log_z_worse"] == pytest.approx(2.0)
    assert found["masses_worse"] == found["lost_worse"] == pytest.approx(0.0)
    assert measure.worse(first, other, known, 1)["log_z_worse"] == pytest.approx(-2.0)
    assert measure.worse(first, first, known, 1)["log_z_worse"] == 0.0


def test_a_reference_without_a_grid_agrees_with_one():
    """The corridor is known by symmetry; the reference filter finds the same."""
    make, _ = SCENES["corridor"]
    scene = make(5, 0)
    exact = measure.truth(scene, 10, 0)
    assert (exact.errors == 0).all()
    found = measure.truth(scene._replace(exact=None), 20_000, 0)
    assert (np.abs(found.masses - exact.masses) <= 5 * found.errors).all()
    assert found.masses.sum() == pytest.approx(1.0, abs=1e-4)


def test_a_reference_finds_the_log_z_of_the_grid():
    scene = SCENES["jumps"][0](3, 0)
    exact = measure.truth(scene, 10, 0)
    found = measure.truth(scene._replace(exact=None), 20_000, 0)
    assert abs(found.log_z - exact.log_z) <= 4 * found.log_z_error
    assert (np.abs(found.masses - exact.masses) <= 5 * found.errors).all()


def test_masses_are_those_of_regions():
    make, _ = SCENES["quadratic"]
    scene = make(3, 0)
    mixture = FILTERS["PF"](scene, 50).init(jax.random.key(0))
    above = float(np.mean(np.asarray(mixture.particles) > 0))
    np.testing.assert_allclose(masses(scene, mixture), [1 - above, above], rtol=1e-5)


@pytest.mark.parametrize("scenes", thorough([["corridor"], ["bearings", "look-alikes"]]))
def test_a_row_for_each_scene_filter_and_size(scenes, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(command.importlib.util, "find_spec", lambda name: None)
    arguments = [
        "--scenes", *scenes, "--filters", "PF", "MPF, rqmc", "--particles", "20", "--seeds", "3",
        "--steps", "3", "--reference", "100", "--keys", "7", "--out", str(tmp_path),
    ]  # fmt: skip
    assert command.main(arguments) == 0
    rows = json.loads((tmp_path / "masses.json").read_text())["rows"]
    assert [(row["scene"], row["filter"], row["N"]) for row in rows] == [
        (scene, name, size) for scene in scenes for size in (20,) for name in ("PF", "MPF, rqmc")
    ]
    for row in rows:
        assert 0 <= row["mass_rmse"] <= 1
        assert row["log_z_sd"] >= 0
        assert row["ms"] > 0
    assert (tmp_path / "masses.png").stat().st_size > 10_000
    assert ["log_z_worse" in row for row in rows] == [False, True] * len(scenes)
    printed = capsys.readouterr().out
    assert "pip install particles" in printed
    assert "worse than PF by so many standard errors" in printed
