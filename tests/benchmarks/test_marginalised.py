"""Each part has its rows, and all filters estimate the same probabilities of the regimes."""

import json

import jax
import numpy as np
import pytest

import mpfjax
from benchmarks import marginalised
from benchmarks.masses import bearings
from benchmarks.masses.marginalised_bearings import MarginalisedBearings


@pytest.mark.thorough
def test_a_row_for_each_move_and_filter(tmp_path, capsys):
    arguments = [
        "--particles", "8", "--sizes", "400", "--steps", "5", "--seeds", "2", "--repeats", "1",
        "--reference", "2000", "--out", str(tmp_path), "--parts", "time", "regimes",
    ]  # fmt: skip
    assert marginalised.main(arguments) == 0
    results = json.loads((tmp_path / "marginalised.json").read_text())["results"]
    assert [row["move"] for row in results["time"]] == [
        "plain", "marginalised", "marginalised, mixed"
    ]  # fmt: skip
    assert all(row["ns a particle and step"] > 0 for row in results["time"])
    filters = {row["filter"]: row["RMS error"] for row in results["regimes"]}
    assert {"plain", "marginalised", "fully adapted", "all children"} <= filters.keys()
    assert 0 < max(filters.values()) < 0.1
    said = "dynamax is not there: pip install" in capsys.readouterr().out
    assert said != ("dynamax" in filters)


@pytest.mark.thorough
def test_the_velocity_is_marginalised_exactly():
    """Both filters of the bearings, one with drawn velocities, have the same evidence and mean."""
    keys = jax.random.split(jax.random.key(0), 200)
    observations = bearings.observations(4, 0)

    def first(mixture):
        states = mixture.particles
        is_drawn = isinstance(states, dict)
        return mixture.average(states["motion"][:, 0] if is_drawn else states.latent[:, 0])

    runs = [
        mpfjax.monte_carlo(keys, mpfjax.particle_filter(model, 500), observations, first)
        for model in (bearings.BearingsModel(), MarginalisedBearings())
    ]
    weights = [np.exp(np.asarray(run.log_marginal_likelihood)) for run in runs]
    for of_run in (lambda run: 1.0, lambda run: np.asarray(run.collected)[:, -1]):
        one, other = (own * of_run(run) for own, run in zip(weights, runs, strict=True))
        error = np.hypot(one.std(), other.std()) / np.sqrt(len(keys))
        assert error < 0.1 * one.mean()
        assert abs(one.mean() - other.mean()) < 4 * error


def test_errors_between_sizes_are_on_a_line_of_logarithms():
    taken = {("a", 10): 1.0, ("a", 100): 100.0}
    errors = {("a", 10): 0.4, ("a", 100): 0.1}
    assert marginalised._error_at(10.0, taken, errors, "a") == pytest.approx(np.sqrt(0.04))


def test_a_part_that_is_not_there_is_named(capsys):
    with pytest.raises(SystemExit):
        marginalised.main(["--parts", "space"])
    assert "space" in capsys.readouterr().err
