"""A study that is broken off, however it is, ends as one that was left alone."""

import shutil

import jax
import numpy as np
import pytest

import mpfjax
from mpfjax import read_study, run_study
from tests.user_models import TrickyQuadraticModel, nothing_traced

NUM_CELLS = 5
OBSERVATIONS = np.array([1.5, 1.0, 0.4], np.float32)


def build(num_particles, noise):
    return mpfjax.particle_filter(mpfjax.QuadraticModel(0.3, noise, -2.0, 2.0), num_particles)


def mean(mixture):
    return mixture.mean()


def measure(run):
    return {"evidence": run.log_marginal_likelihood, "means": run.collected}


def small_study(num_cells=5, **changes):
    """Cells that differ in a number only, so that all of them are one program."""
    arguments = {
        "filters": {"pf": build},
        "num_particles": [8],
        "keys": jax.random.split(jax.random.key(0), 4),
        "observations": OBSERVATIONS,
        "settings": {"noise": np.linspace(0.1, 1.0, num_cells)},
        "measure": measure,
        "collect": mean,
    }
    return mpfjax.Study(**arguments | changes)


def contents(directory):
    """Every file in a folder, to the byte, but for what a killed writer left."""
    kept = [path for path in sorted(directory.iterdir()) if path.suffix != ".partial"]
    return {path.name: path.read_bytes() for path in kept}


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """A study that was left alone: its folder and results."""
    directory = tmp_path_factory.mktemp("alone")
    return directory, run_study(small_study(NUM_CELLS), directory)


@pytest.fixture
def copy(alone, tmp_path):
    """A copy of its folder, to spoil."""
    return shutil.copytree(alone[0], tmp_path / "copy")


def files_of(directory):
    return sorted(directory.glob("*.npz"))


def tricky(num_particles, noise):
    model = TrickyQuadraticModel(0.3, noise, -2.0, 2.0)
    return mpfjax.particle_filter(model, num_particles)


def breaking(error, after):
    """What `measure` does, until after so many cells it raises."""
    calls = []

    def measure(run):
        calls.append(run)
        if len(calls) > after:
            raise error
        return {"evidence": run.log_marginal_likelihood, "means": run.collected}

    return measure


class TestResults:
    @pytest.mark.exactness
    def test_are_those_of_monte_carlo_for_each_cell(self, tmp_path):
        study = small_study(2, filters={"pf": build, "tricky": tricky})
        results = run_study(study, tmp_path)
        cells = [(entry["filter"], entry["num_particles"], entry["noise"]) for entry in results]
        assert cells == [("pf", 8, 0.1), ("tricky", 8, 0.1), ("pf", 8, 1.0), ("tricky", 8, 1.0)]
        for entry, function in zip(results, [build, tricky, build, tricky], strict=True):
            filter = function(entry["num_particles"], entry["noise"])
            run = mpfjax.monte_carlo(study.keys, filter, OBSERVATIONS, mean)
            np.testing.assert_allclose(entry["evidence"], run.log_marginal_likelihood, rtol=1e-5)
            np.testing.assert_allclose(entry["means"], run.collected, rtol=1e-4)
        np.testing.assert_equal(read_study(tmp_path), results)
        plain = mpfjax.Study(
            {"pf": build}, [8], study.keys, OBSERVATIONS, settings={"noise": [0.1]}
        )
        (entry,) = run_study(plain, tmp_path / "plain")
        np.testing.assert_allclose(entry["log_marginal_likelihood"], results[0]["evidence"], 1e-5)

    @pytest.mark.exactness
    def test_of_one_shape_or_within_shared_slots_compile_once(self, tmp_path):
        def one(sizes, num_cells=1):
            return small_study(num_cells, filters={"pf": tricky}, num_particles=sizes)

        run_study(one([5]), tmp_path / "one", num_slots=9)
        with nothing_traced():
            run_study(one([4, 7, 9], 2), tmp_path / "two", num_slots=9)
        with pytest.raises(AssertionError, match="traced > 0 times"), nothing_traced():
            run_study(one([4, 11]), tmp_path / "three", num_slots=9)  # eleven do not fit
        results = run_study(one([4, 11]), tmp_path / "three", num_slots=9, resume=True)
        for cell, same in zip(results, run_study(one([4, 11]), tmp_path / "four"), strict=True):
            np.testing.assert_allclose(cell["evidence"], same["evidence"], rtol=1e-4)


class TestBrokenOff:
    @pytest.mark.parametrize("error", [KeyboardInterrupt(), RuntimeError("mine")])
    def test_goes_on_with_what_is_left(self, alone, tmp_path, error):
        study = small_study(NUM_CELLS, measure=breaking(error, after=2))
        with pytest.raises(type(error)) as caught:
            run_study(study, tmp_path)
        if isinstance(error, RuntimeError):
            assert "'num_particles': 8, 'noise': 0.55" in caught.value.__notes__[0]
        assert len(read_study(tmp_path)) == 2
        finished = {path: path.stat().st_mtime_ns for path in files_of(tmp_path)}
        study = small_study(NUM_CELLS, measure=breaking(RuntimeError("again"), NUM_CELLS - 2))
        np.testing.assert_equal(run_study(study, tmp_path, resume=True), alone[1])
        assert all(path.stat().st_mtime_ns == time for path, time in finished.items())


class TestOtherFiles:
    @pytest.mark.parametrize(
        ("changes", "named"),
        [
            ({"num_particles": [8, 16]}, r"num_particles is \[8\] there and \[8, 16\] here"),
            ({"filters": {"other": build}}, r"filter is \['pf'\] there and \['other'\] here"),
            ({"num_cells": 4}, r"noise is \[0.1, .*\] there"),
            ({"keys": jax.random.split(jax.random.key(1), 4)}, "keys is "),
            ({"observations": OBSERVATIONS + np.float32(1)}, "observations is "),
            ({"measure": lambda run: measure(run)}, "measure is <function measure> there"),
        ],
    )
    def test_a_folder_of_another_study_is_refused_by_what_differs(self, alone, changes, named):
        before = contents(alone[0])
        with pytest.raises(ValueError, match=rf"directory: .*npz: of another study \(.*{named}"):
            run_study(small_study(**changes), alone[0], resume=True)
        assert contents(alone[0]) == before

    def test_a_folder_that_holds_cells_is_refused_unless_it_is_said(self, alone, copy, capsys):
        """Then it tells how many cells it takes over."""
        with pytest.raises(ValueError, match=r"directory: .*holds 5 cells; resume"):
            run_study(small_study(NUM_CELLS), copy)
        files_of(copy)[-1].unlink()
        results = run_study(small_study(NUM_CELLS), copy, resume=True)
        said = f"{copy}: 4 cells taken over, 1 to run\n"
        assert capsys.readouterr().out == said
        np.testing.assert_equal(results, alone[1])


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"filters": {"pf": lambda n, noise: noise}}, "filters: pf: .* is not a Filter"),
        ({"observations": np.array([1.0, np.nan])}, "observations: NaN or infinite at index 1"),
        ({"measure": lambda run: {"mean": np.ones(3)}}, r"measure: mean of shape \(3,\)"),
    ],
)
def test_bad_input_to_one_cell_is_an_error_before_any_is_written(tmp_path, changes, named):
    with pytest.raises(ValueError, match=named):
        run_study(small_study(1, **changes), tmp_path)
    assert not list(tmp_path.glob("*.npz"))
