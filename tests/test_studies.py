"""A study that is broken off, however it is, ends as one that was left alone."""

import datetime
import errno
import io
import json
import multiprocessing
import os
import signal
import sys
import time

import jax
import numpy as np
import pytest

import mpfjax
from mpfjax.running import studies
from tests.full_disk import no_room_beyond
from tests.small_study import OBSERVATIONS, build, mean, measure, run_in_process, small_study
from tests.user_models import TrickyQuadraticModel, nothing_traced

NUM_CELLS = 5


def contents(directory):
    """Every file in a folder, to the byte."""
    return {path.name: path.read_bytes() for path in sorted(directory.iterdir())}


def assert_same_results(results, others):
    assert [list(entry) for entry in results] == [list(entry) for entry in others]
    for one, two in zip(results, others, strict=True):
        for name, value in one.items():
            np.testing.assert_array_equal(value, two[name])


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """A study that was left alone: its folder and results."""
    directory = tmp_path_factory.mktemp("alone")
    return directory, mpfjax.run_study(small_study(NUM_CELLS), directory)


@pytest.fixture
def copy(alone, tmp_path):
    """A copy of its folder, to spoil."""
    for name, content in contents(alone[0]).items():
        (tmp_path / name).write_bytes(content)
    return tmp_path


def files_of(directory):
    return sorted(directory.glob("*.npz"))


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
    def test_are_those_of_monte_carlo_for_each_cell(self, tmp_path):
        keys = jax.random.split(jax.random.key(0), 4)

        def adaptive(num_particles, noise):
            model = mpfjax.QuadraticModel(0.3, noise, -2.0, 2.0)
            return mpfjax.particle_filter(model, num_particles, ess_threshold=0.5)

        study = small_study(2, filters={"pf": build, "adaptive": adaptive})
        results = mpfjax.run_study(study, tmp_path)
        cells = [(entry["filter"], entry["num_particles"], entry["noise"]) for entry in results]
        assert cells == [("pf", 8, 0.1), ("adaptive", 8, 0.1), ("pf", 8, 1.0), ("adaptive", 8, 1.0)]
        for entry, function in zip(results, [build, adaptive, build, adaptive], strict=True):
            filter = function(entry["num_particles"], entry["noise"])
            run = mpfjax.monte_carlo(keys, filter, OBSERVATIONS, mean)
            np.testing.assert_array_equal(entry["evidence"], run.log_marginal_likelihood)
            np.testing.assert_array_equal(entry["means"], run.collected)

    def test_are_log_likelihoods_where_nothing_is_asked_for(self, alone, tmp_path):
        study = mpfjax.Study({"pf": build}, [8], small_study().keys, OBSERVATIONS, {"noise": [0.1]})
        (entry,) = mpfjax.run_study(study, tmp_path)
        np.testing.assert_allclose(entry["log_marginal_likelihood"], alone[1][0]["evidence"], 1e-5)

    def test_load_without_the_study_and_without_pickles(self, alone):
        directory, results = alone
        assert_same_results(studies.read_study(directory), results)
        assert json.loads((directory / "study.json").read_text())["axes"]["num_particles"] == [8]
        for path, entry in zip(files_of(directory), results, strict=True):
            with np.load(path, allow_pickle=False) as file:
                np.testing.assert_array_equal(file["evidence"], entry["evidence"])

    @pytest.mark.parametrize("options", [{"seeds_at_once": 3}, {"cells_at_once": 2}])
    def test_do_not_depend_on_how_many_run_at_once(self, alone, tmp_path, options):
        results = mpfjax.run_study(small_study(NUM_CELLS), tmp_path, **options)
        for one, two in zip(results, alone[1], strict=True):
            # Another batch size may round its sums otherwise.
            np.testing.assert_allclose(one["evidence"], two["evidence"], rtol=1e-5)

    def test_of_one_shape_compile_once(self, tmp_path):
        def tricky(num_particles, noise):
            model = TrickyQuadraticModel(0.3, noise, -2.0, 2.0)
            return mpfjax.particle_filter(model, num_particles)

        mpfjax.run_study(small_study(1, filters={"pf": tricky}), tmp_path / "one", seeds_at_once=3)
        four = small_study(4, filters={"pf": tricky})
        with nothing_traced():
            mpfjax.run_study(four, tmp_path / "two", seeds_at_once=3)

    def test_of_many_sizes_compile_once_within_shared_slots(self, tmp_path):
        def tricky(num_particles, noise):
            model = TrickyQuadraticModel(0.3, noise, -2.0, 2.0)
            return mpfjax.particle_filter(model, num_particles)

        def one(sizes):
            return small_study(1, filters={"pf": tricky}, num_particles=sizes)

        mpfjax.run_study(one([5]), tmp_path / "one", slots=9)
        with nothing_traced():
            mpfjax.run_study(one([4, 7, 9]), tmp_path / "two", slots=9)
        with pytest.raises(AssertionError, match="traced > 0 times"), nothing_traced():
            mpfjax.run_study(one([4, 11]), tmp_path / "three", slots=9)  # eleven do not fit
        mpfjax.run_study(one([4, 11]), tmp_path / "three", slots=9, resume=True)
        results = studies.read_study(tmp_path / "three")
        alone = mpfjax.run_study(one([4, 11]), tmp_path / "four")
        for cell, same in zip(results, alone, strict=True):
            np.testing.assert_allclose(cell["evidence"], same["evidence"], rtol=1e-4)


class TestBrokenOff:
    @pytest.mark.parametrize("cells_at_once", [1, 2])
    @pytest.mark.parametrize("error", [KeyboardInterrupt(), RuntimeError("mine")])
    def test_goes_on_with_what_is_left(self, alone, tmp_path, error, cells_at_once):
        study = small_study(NUM_CELLS, measure=breaking(error, after=2))
        with pytest.raises(type(error)):
            mpfjax.run_study(study, tmp_path, cells_at_once=cells_at_once)
        assert len(studies.read_study(tmp_path)) == 2
        finished = {path: path.stat().st_mtime_ns for path in files_of(tmp_path)}

        study = small_study(NUM_CELLS, measure=breaking(error, after=NUM_CELLS - 2))
        assert_same_results(mpfjax.run_study(study, tmp_path, resume=True), alone[1])
        assert all(path.stat().st_mtime_ns == time for path, time in finished.items())

    def test_an_error_says_in_which_cell(self, tmp_path):
        study = small_study(NUM_CELLS, measure=breaking(RuntimeError("mine"), after=1))
        with pytest.raises(RuntimeError) as info:
            mpfjax.run_study(study, tmp_path)
        assert info.value.__notes__ == [
            "in the cell {'filter': 'pf', 'num_particles': 8, 'noise': 0.325}"
        ]

    @pytest.mark.thorough
    def test_ten_times_by_sigkill_it_ends_as_if_left_alone(self, tmp_path):
        """Each process is forked off one that has imported everything, which takes longest."""
        num_cells, rng = 80, np.random.default_rng(0)
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload(["tests.small_study"])

        def start(directory):
            arguments = (directory, num_cells, tmp_path / "compiled")
            process = context.Process(target=run_in_process, args=arguments)
            process.start()
            return process

        left_alone = start(tmp_path / "alone")
        left_alone.join()
        assert left_alone.exitcode == 0

        killed = tmp_path / "killed"
        finished, start_up = [], 0.0
        for k in range(10):
            began, process = time.monotonic(), start(killed)
            # Every third dies while it starts, the others while they run or write a cell.
            starts = k % 3 == 2
            wanted = len(files_of(killed)) + rng.integers(1, 5)
            until = began + (rng.uniform(0, start_up) if starts else 60)
            while len(files_of(killed)) < wanted and time.monotonic() < until:
                time.sleep(0.001)
            if not starts:
                start_up = time.monotonic() - began
                time.sleep(rng.uniform(0, 0.01))
            process.kill()
            process.join()
            assert process.exitcode == -signal.SIGKILL
            finished.append(len(files_of(killed)))
        assert finished == sorted(finished)
        assert 6 < finished[-1] < num_cells

        last = start(killed)
        last.join()
        assert last.exitcode == 0
        assert contents(killed) == contents(tmp_path / "alone")
        assert len(studies.read_study(killed)) == num_cells


class TestSeveralProcesses:
    def test_only_the_first_writes_and_all_have_the_results(self, alone, tmp_path, monkeypatch):
        monkeypatch.setattr(jax, "process_index", lambda: 1)
        results = mpfjax.run_study(small_study(NUM_CELLS), tmp_path)
        assert_same_results(results, alone[1])
        assert not list(tmp_path.iterdir())

    def test_run_the_cells_in_one_order(self, copy, monkeypatch):
        for path in files_of(copy):
            path.unlink()

        def in_one_process(*arguments, **options):
            with monkeypatch.context() as patch:
                patch.setattr(jax, "process_count", lambda: 1)
                return mpfjax.monte_carlo(*arguments, **options)

        monkeypatch.setattr(jax, "process_count", lambda: 2)
        monkeypatch.setattr(studies, "monte_carlo", in_one_process)
        monkeypatch.setattr(studies, "ThreadPoolExecutor", None)
        mpfjax.run_study(small_study(NUM_CELLS), copy, cells_at_once=2)


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
        with pytest.raises(ValueError, match=f"directory: .* holds another study .*{named}"):
            mpfjax.run_study(small_study(**changes), alone[0], resume=True)
        assert contents(alone[0]) == before

    def test_a_study_of_another_version_is_refused(self, copy, monkeypatch):
        monkeypatch.setattr(mpfjax, "__version__", "0.0.1")
        with pytest.raises(ValueError, match=r"versions is \['mpfjax .* there and \['mpfjax 0.0.1"):
            mpfjax.run_study(small_study(NUM_CELLS), copy, resume=True)

    def test_a_folder_that_holds_cells_is_refused_unless_it_is_said(self, copy, capsys):
        """Whatever they are of: a filter that does another thing cannot be told from this one."""
        other = {"filters": {"pf": lambda n, noise: build(n, 2 * noise)}}
        before, day = contents(copy), datetime.date.today().isoformat()
        for study in (small_study(NUM_CELLS), small_study(NUM_CELLS, **other)):
            with pytest.raises(ValueError, match=f"directory: .*holds 5 finished cells of {day}"):
                mpfjax.run_study(study, copy)
        assert contents(copy) == before
        assert capsys.readouterr() == ("", "")

    def test_on_resuming_it_says_how_many_cells_it_takes_over_and_of_which_day(
        self, alone, copy, capsys
    ):
        noon = datetime.datetime(2020, 2, 29, 12).timestamp()
        files_of(copy)[-1].unlink()
        for path in files_of(copy):
            os.utime(path, (noon, noon))
        results = mpfjax.run_study(small_study(NUM_CELLS), copy, resume=True)
        assert capsys.readouterr().out == (
            f"{copy}: 4 finished cells of 2020-02-29 taken over, 1 to run\n"
        )
        assert_same_results(results, alone[1])
        mpfjax.run_study(small_study(NUM_CELLS), copy, resume=True)
        today = datetime.date.today().isoformat()
        assert f"5 finished cells of 2020-02-29 to {today} taken over" in capsys.readouterr().out

    def test_a_folder_without_cells_begins_anew(self, alone, copy):
        for path in files_of(copy):
            path.unlink()
        (copy / "study.json").write_text("of a study that had no cell yet")
        assert_same_results(mpfjax.run_study(small_study(NUM_CELLS), copy), alone[1])
        assert contents(copy) == contents(alone[0])

    def test_a_cell_of_another_study_is_refused_by_its_file(self, copy, tmp_path_factory):
        directory = tmp_path_factory.mktemp("other")
        keys = jax.random.split(jax.random.key(1), 4)
        mpfjax.run_study(small_study(NUM_CELLS, keys=keys), directory)
        foreign = files_of(directory)[2]
        (copy / foreign.name).write_bytes(foreign.read_bytes())
        with pytest.raises(ValueError, match=f"{foreign.name}: results of another study"):
            mpfjax.run_study(small_study(NUM_CELLS), copy, resume=True)

    def test_files_that_are_cut_off_are_named_and_only_their_cells_run_again(self, alone, copy):
        damaged = files_of(copy)[1:3]
        times = {path: path.stat().st_mtime_ns for path in files_of(copy)}
        for path in damaged:
            path.write_bytes(path.read_bytes()[:-200])
        before = contents(copy)
        with pytest.raises(ValueError, match=f"{damaged[0].name}: cut off.*{damaged[1].name}: cut"):
            mpfjax.run_study(small_study(NUM_CELLS), copy, resume=True)
        assert contents(copy) == before
        for path in damaged:
            path.unlink()
        assert_same_results(mpfjax.run_study(small_study(NUM_CELLS), copy, resume=True), alone[1])
        again = [path for path, time in times.items() if path.stat().st_mtime_ns != time]
        assert again == damaged

    @pytest.mark.parametrize(
        "content",
        [
            "", '{"axes"', "[]", "{}", "null", "3", '"cells"', "[" * 200_000,
            '{"axes": null}', '{"axes": ["filter"]}',
        ],
        ids=range(10),
    )  # fmt: skip
    def test_a_description_that_is_none_is_named(self, copy, content):
        (copy / "study.json").write_text(content)
        for use in (lambda: mpfjax.run_study(small_study(NUM_CELLS), copy, resume=True),
                    lambda: studies.read_study(copy)):  # fmt: skip
            with pytest.raises(ValueError, match=r"study.json: "):
                use()
        assert len(files_of(copy)) == NUM_CELLS

    def test_a_folder_without_a_study_is_named(self, tmp_path):
        with pytest.raises(FileNotFoundError, match=r"study.json"):
            studies.read_study(tmp_path)


class TestFullDisk:
    def test_keeps_what_was_finished_and_goes_on_once_there_is_room(self, alone, copy, capsys):
        missing = files_of(copy)[3:]
        for path in missing:
            path.unlink()
        before = contents(copy)
        for room in (0, 300):
            with pytest.raises(OSError, match=missing[0].name) as info, no_room_beyond(room):
                mpfjax.run_study(small_study(NUM_CELLS), copy, resume=True)
            assert info.value.errno == errno.EFBIG
            assert contents(copy) == before
        assert_same_results(mpfjax.run_study(small_study(NUM_CELLS), copy, resume=True), alone[1])

    def test_noticed_only_when_the_disk_is_synced(self, tmp_path, monkeypatch):
        real, calls = os.fsync, []

        def full(descriptor):
            calls.append(descriptor)
            if len(calls) > 3:
                raise OSError(errno.ENOSPC, "No space left on device")
            real(descriptor)

        monkeypatch.setattr(os, "fsync", full)
        with pytest.raises(OSError, match="No space left on device") as info:
            mpfjax.run_study(small_study(NUM_CELLS), tmp_path)
        assert info.value.errno == errno.ENOSPC
        assert len(studies.read_study(tmp_path)) == 2
        assert not list(tmp_path.glob("*.partial"))


class TestProgress:
    def test_is_shown_on_a_terminal_with_the_time_left(self, copy, monkeypatch):
        class Terminal(io.StringIO):
            def isatty(self):
                return True

        files_of(copy)[-1].unlink()
        terminal = Terminal()
        monkeypatch.setattr(sys, "stderr", terminal)
        mpfjax.run_study(small_study(NUM_CELLS), copy, resume=True)
        shown = terminal.getvalue().split("\r")
        assert "4/5 [00:00<?" in shown[1]
        assert "5/5 [00:00<00:00" in shown[-1]

    def test_is_not_shown_elsewhere(self, tmp_path, capsys):
        mpfjax.run_study(small_study(1), tmp_path)
        assert capsys.readouterr() == ("", "")
