"""Rivals are timed on the same job, and only where they give the same answer."""

import dataclasses
import importlib.util
import json

import jax
import numpy as np
import pytest

from benchmarks.peers import __main__ as peers
from benchmarks.peers.comparison import disagreement
from benchmarks.peers.jobs import JOBS
from benchmarks.peers.libraries import jax_functions, model_of, prepare
from benchmarks.peers.worker import Worker
from mpfjax.exact import kalman_filter

# They are no part of the tests' own extra: particles 0.4 would take numpy and JAX back.
NO_RIVAL = "a library to compare with comes with the extra 'bench'"
PARTICLES = importlib.util.find_spec("particles") is not None


@pytest.fixture(scope="module")
def content(tmp_path_factory):
    """A real run of mpfjax, and of particles where it is installed, with little of everything."""
    names = ["mpfjax", "particles"][: 1 + PARTICLES]
    out = tmp_path_factory.mktemp("peers")
    arguments = ["--particles", "64", "--seeds", "10", "--repeats", "2", "--out", str(out)]
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr(peers, "chosen_libraries", lambda options: names)
        assert peers.main([*arguments, "--jobs", "quadratic"]) == 0
    assert (out / "peers.png").stat().st_size > 5000
    return json.loads((out / "peers.json").read_text())


def test_every_library_that_is_there_is_timed(content):
    names = {entry["library"] for entry in content["results"]}
    assert names == {"mpfjax", "particles"} if PARTICLES else {"mpfjax"}
    assert set(content["libraries"]) == names
    for entry in content["results"]:
        assert entry["refused"] is None
        assert len(entry["seconds"]) == 2
        assert min(entry["seconds"]) > 0
        assert entry["start"] >= 0
        assert entry["memory"] > 0
        assert (entry["ratio"] == 1) == (entry["library"] == "mpfjax")


@pytest.mark.parametrize("job", JOBS.values(), ids=list(JOBS))
def test_plain_functions_are_those_of_the_model(job):
    functions, model = jax_functions(job), model_of(job)
    states = functions.initial(jax.random.key(0), (50, *job.state_shape))
    observation = jax.numpy.asarray(job.observations[3])
    expected = model.log_likelihood(observation, states)
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        found = functions.log_likelihood(observation, states)
        moved = functions.transition(jax.random.key(1), states)
    np.testing.assert_allclose(found, expected, rtol=2e-4, atol=1e-4)
    np.testing.assert_allclose(
        moved, model.sample_transition(jax.random.key(1), states), rtol=1e-4, atol=1e-5
    )


@pytest.mark.parametrize("job", JOBS.values(), ids=list(JOBS))
def test_particles_weighs_like_the_model(job):
    pytest.importorskip("particles", reason=NO_RIVAL)
    from benchmarks.peers import through_particles

    kinds = {
        JOBS["quadratic"]: through_particles.QuadraticFeynmanKac,
        JOBS["constant_velocity"]: through_particles.ConstantVelocityFeynmanKac,
    }
    states = np.random.default_rng(0).standard_normal((50, *job.state_shape))
    observation = jax.numpy.asarray(job.observations[3])
    expected = model_of(job).log_likelihood(observation, jax.numpy.asarray(states, "float32"))
    found = kinds[job](job).logG(3, None, states)
    np.testing.assert_allclose(found, expected, rtol=2e-4, atol=1e-4)


@pytest.mark.parametrize("library", ["blackjax", "cuthbert"])
def test_rivals_in_jax_estimate_the_likelihood(library):
    pytest.importorskip(library, reason=NO_RIVAL)
    job = dataclasses.replace(JOBS["constant_velocity"], num_steps=5)
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        prepared = prepare(library, job, num_particles=2000, num_seeds=4)
        means, sizes, log_likelihoods = prepared.run(prepared.make_input(0))
    exact = kalman_filter(model_of(job), jax.numpy.asarray(job.observations))
    np.testing.assert_allclose(log_likelihoods, exact.log_marginal_likelihood, atol=0.5)
    np.testing.assert_allclose(means.mean(axis=0), exact.means, atol=0.15)
    assert sizes.shape == (4, 5)
    assert 1 < sizes.min() < sizes.max() < 2000


def made_up(log_likelihood=-10.0, size=50.0, spread=0.3):
    """Twenty runs around these numbers; log E[Ẑ] is the given log-likelihood."""
    noise = np.random.default_rng(0).standard_normal((2, 20))
    noise = (noise - noise.mean(axis=1, keepdims=True)) / noise.std(axis=1, ddof=1, keepdims=True)
    return {
        "seconds": 1.0,
        "memory": 10,
        "log_likelihoods": (log_likelihood - spread**2 / 2 + spread * noise[0]).tolist(),
        "effective_sample_sizes": (size + 0.5 * noise[1]).tolist(),
    }


def test_the_same_numbers_agree():
    assert disagreement(made_up(-10.1, 50.2), made_up(), exact=-10.0) is None


@pytest.mark.parametrize(
    ("found", "reference", "reason"),
    [
        (made_up(log_likelihood=-11), made_up(), "mean log likelihoods -11"),
        (made_up(size=53), made_up(), "mean effective sample sizes 53, not 50"),
        (made_up(log_likelihood=-11), made_up(log_likelihood=-11), "exactly -10"),
        (made_up(log_likelihood=np.nan), made_up(), "not finite"),
    ],
)
def test_other_numbers_are_refused(found, reference, reason):
    assert reason in disagreement(found, reference, exact=-10.0)


def test_estimates_that_spread_much_are_held_against_the_reference_only():
    wide = made_up(log_likelihood=-30, spread=4.0)
    assert disagreement(wide, wide, exact=-10.0) is None


class Scripted:
    """Stands in for a library's process: gives made-up answers, and counts the questions."""

    def __init__(self, **answer):
        self.found = made_up() | answer
        self.runs = 0

    def answer(self, time_limit):
        return {"version": "1"}

    def run(self, time_limit, **request):
        self.runs += 1
        return self.found

    def dismiss(self):
        pass

    def stop(self, patience=0.0):
        pass


def run_scripted(monkeypatch, out, **workers):
    monkeypatch.setattr(peers, "chosen_libraries", lambda options: list(workers))
    monkeypatch.setattr(peers, "start", lambda name, job, devices: workers[name])
    monkeypatch.setattr(peers, "exact_log_likelihood", lambda job: -10.0)
    arguments = ["--jobs", "quadratic", "--particles", "10", "20", "--repeats", "5"]
    status = peers.main([*arguments, "--out", str(out)])
    path = out / "peers.json"
    return status, json.loads(path.read_text())["results"] if path.exists() else []


def test_what_disagrees_is_not_timed(tmp_path, monkeypatch, capsys):
    wrong = Scripted(log_likelihoods=made_up(-12)["log_likelihoods"])
    status, results = run_scripted(monkeypatch, tmp_path, mpfjax=Scripted(), blackjax=wrong)
    assert status == 1
    assert wrong.runs == 2  # the first of each size
    entries = {(entry["library"], entry["particles"]): entry for entry in results}
    assert entries["blackjax", 10]["median"] is None
    assert "mean log likelihoods" in entries["blackjax", 10]["refused"]
    assert entries["mpfjax", 20]["median"] == 1
    printed = capsys.readouterr()
    assert "N = 10: blackjax is not timed" in printed.err
    assert "refused" in printed.out


def test_a_library_that_fails_is_left_out_and_the_rest_goes_on(tmp_path, monkeypatch, capsys):
    failing = Scripted(error="out of memory")
    status, results = run_scripted(monkeypatch, tmp_path, mpfjax=Scripted(), cuthbert=failing)
    assert status == 0
    assert failing.runs == 1
    assert [entry["library"] for entry in results] == ["mpfjax", "mpfjax"]
    assert "cuthbert failed and is left out from here on: out of memory" in capsys.readouterr().err


def test_without_mpfjax_there_is_nothing_to_compare(tmp_path, monkeypatch, capsys):
    status, _ = run_scripted(monkeypatch, tmp_path, mpfjax=Scripted(error="broken"))
    assert status == 2
    assert "mpfjax: broken" in capsys.readouterr().err


def test_a_slow_library_is_timed_less_often_and_ratios_are_of_medians(tmp_path, monkeypatch):
    slow = Scripted(seconds=15.0)
    _, results = run_scripted(monkeypatch, tmp_path, mpfjax=Scripted(), blackjax=slow)
    entry = next(entry for entry in results if entry["library"] == "blackjax")
    assert len(entry["seconds"]) == 3
    assert entry["ratio"] == 15


def test_a_rival_that_is_not_installed_is_named(monkeypatch, capsys):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert peers.chosen_libraries(peers.parse(["--devices", "2"])) == ["mpfjax", "mpfjax_devices"]
    assert "cuthbert is not installed and left out" in capsys.readouterr().err
    assert peers.chosen_libraries(peers.parse(["--skip", *peers.RIVALS])) == ["mpfjax"]
    assert capsys.readouterr().err == ""
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: name)
    rivals = ["particles", "particles_2", "blackjax", "cuthbert"]
    assert peers.chosen_libraries(peers.parse([])) == ["mpfjax", *rivals]


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--seeds", "2"], "--seeds: '2'"),
        (["--particles", "100", "1"], "--particles: '1'"),
        (["--repeats", "0"], "--repeats: '0'"),
        (["--devices", "0"], "--devices: '0'"),
        (["--time-limit", "0"], "--time-limit: '0'"),
        (["--skip", "mpfjax"], "--skip"),
    ],
)
def test_bad_options_are_refused_by_name(arguments, named, capsys):
    with pytest.raises(SystemExit):
        peers.main(arguments)
    assert named in capsys.readouterr().err


def test_a_process_that_does_not_answer_in_time_is_ended():
    worker = Worker("mpfjax", "quadratic")
    assert "no answer within 0.01 s" in worker.answer(0.01)["error"]
