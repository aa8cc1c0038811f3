"""The smoothing benchmark: its exact answers, and a run with little of everything."""

import json

import numpy as np
import pytest

from benchmarks.smoothing import __main__ as smoothing
from benchmarks.smoothing import accuracy, modes, posteriors
from benchmarks.smoothing.jobs import Linear, Quadratic
from tests.smoothing.exact_smoothers import gaussian_smoother, grid_smoother


def test_the_linear_truth_is_that_of_one_large_gaussian():
    job = Linear(6, 1)
    model = type("Model", (), {
        "A": [[job.a]], "Q": [[job.q**2]], "H": [[1.0]], "R": [[job.r**2]], "m0": [0.0],
        "P0": [[job.p**2]],
    })  # fmt: skip
    means, covariance = gaussian_smoother(model, job.observations[:, None])
    x = means[:, 0]
    expected = np.mean(np.diagonal(covariance, 1) + x[:-1] * x[1:])
    assert job.exact == pytest.approx(expected)


def test_the_quadratic_truth_is_that_of_another_grid():
    job, grid = Quadratic(6, 1), np.linspace(-4, 4, 701)
    log_initial = np.where(np.abs(grid) <= job.width, 0.0, -np.inf)
    log_transition = -0.5 * ((grid[None] - grid[:, None]) / job.sigma_x) ** 2
    log_likelihoods = -0.5 * ((job.observations[:, None] - grid**2) / job.sigma_y) ** 2
    _, pairs = grid_smoother(log_initial, log_transition, log_likelihoods)
    expected = np.mean(np.einsum("sij,i,j->s", pairs, grid, grid))
    assert job.exact == pytest.approx(expected, rel=1e-3)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr(modes, "NUM_TRAJECTORIES", 50)
        for table, names in (
            (modes.FILTERS, ["multinomial PF", "MPF", "guided MPF"]),
            (accuracy.OURS, ["backward sampling", "PaRIS"]),
            (smoothing.JOBS, ["quadratic"]),
        ):
            for name in names:
                monkeypatch.delitem(table, name)
        out = tmp_path_factory.mktemp("smoothing")
        arguments = [
            "--steps", "10", "--particles", "150", "--runs", "3", "--mode-particles", "60",
            "--seeds", "4", "--variance-particles", "40", "--variance-runs", "100",
            "--schemes", "multinomial", "--parts", "accuracy", "modes", "variance",
            "--out", str(out),
        ]  # fmt: skip
        assert smoothing.main(arguments) == 0
    return out


@pytest.fixture(scope="module")
def content(folder):
    return json.loads((folder / "smoothing.json").read_text())


def test_every_method_comes_close_to_the_truth(content):
    entries = content["accuracy"]["linear"]
    assert len({entry["method"] for entry in entries}) >= 3
    for entry in entries:
        assert entry["seconds"] > 0
        assert entry["rms_error"] < 0.2, entry


def test_masses_and_variances(content, folder):
    found = content["modes"]
    assert "PF, genealogy" in found
    best = found["auxiliary MPF, backward sampling"]
    assert best["worst_rms_error"] < 0.2
    assert best["lost_at_some_time"] == 0
    assert {entry["filter"] for entry in content["variance"]} == {"PF", "MPF"}
    for entry in content["variance"]:
        assert entry["variance"] > 0
        assert -1 < entry["mean_of_runs"] < 2
    for name in ("accuracy.png", "modes.png"):
        assert (folder / name).stat().st_size > 10_000


@pytest.mark.thorough
def test_every_sampler_comes_close_to_the_grid_filters_posterior(tmp_path, monkeypatch):
    pytest.importorskip("blackjax", reason="PMMH needs the extra 'mcmc', which 'test' brings")
    monkeypatch.setattr(posteriors, "AXIS", posteriors.AXIS[::3])
    arguments = ["--steps", "12", "--posterior-particles", "30", "--posterior-steps", "300"]
    assert smoothing.main([*arguments, "--parts", "posteriors", "--out", str(tmp_path)]) == 0
    entries = json.loads((tmp_path / "smoothing.json").read_text())["posteriors"]
    assert {entry["sampler"] for entry in entries} == {
        "grid filter", "PMMH", "particle Gibbs", "SMC²"
    }  # fmt: skip
    for name in posteriors.NAMES:
        own = [entry for entry in entries if entry["parameter"] == name]
        truth = next(entry for entry in own if entry["sampler"] == "grid filter")
        for entry in own:
            assert abs(entry["mean"] - truth["mean"]) < 0.6 * truth["deviation"], entry
    assert (tmp_path / "posteriors.png").stat().st_size > 10_000
