"""The benchmark of section 5.1 does what its help says, and scores what the filters did."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from benchmarks import score_vs_particles as benchmark


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    """One short study, all three filters."""
    out = tmp_path_factory.mktemp("score")
    status = benchmark.main(["--seeds", "3", "--particles", "20", "40", "--out", str(out)])
    assert status == 0
    return out, json.loads((out / "score_vs_particles.json").read_text())


def test_writes_one_entry_for_each_filter_and_size_with_one_score_a_seed(study):
    _, written = study
    entries = {(entry["filter"], entry["particles"]) for entry in written["results"]}
    assert entries == {(f, n) for f in ("pf", "mpf", "guided_mpf") for n in (20, 40)}
    for entry in written["results"]:
        assert len(entry["scores"]) == 3
        assert all(0 <= score <= 1 for score in entry["scores"])
        assert {"weight_mean", "weight_std", "mode_mass_error"} <= entry.keys()
    assert written["settings"]["seeds"] == 3


def test_scores_are_those_of_the_filters_own_particles(study):
    """Run the mixture particle filter again, and score it here with numpy alone."""
    _, written = study
    model = mpfjax.QuadraticModel(0.1, 0.1, -2.5, 2.5)
    truth, observations = benchmark.simulate(written["settings"]["data_seed"])
    keys = jax.random.split(jax.random.fold_in(jax.random.key(written["settings"]["seed"]), 1), 3)
    regroup = [mpfjax.Merge(), mpfjax.Split(), mpfjax.KMeans()]
    filter = mpfjax.mixture_particle_filter(model, 20, 2, regroup=regroup, regroup_every=1)
    filter = mpfjax.with_resampling(filter, mpfjax.Resample(allocation="equal"))
    filter = mpfjax.with_selected_start(filter, 1)
    expected = []
    for key in keys:
        collected = mpfjax.run_filter(key, filter, observations).collected
        positions = np.where(collected.log_weights > -np.inf, collected.particles, np.inf)
        gaps = [np.abs(positions - sign * np.asarray(truth)[:, None]).min(1) for sign in (1, -1)]
        expected.append(np.mean((gaps[0] < 0.3) & (gaps[1] < 0.3)))
    (entry,) = [e for e in written["results"] if (e["filter"], e["particles"]) == ("mpf", 20)]
    # Under vmap the sums run in another order, which can move a particle across the border.
    np.testing.assert_allclose(entry["scores"], expected, atol=0.02)


def test_draws_both_figures(study):
    out, _ = study
    for name in ("score_vs_particles.png", "typical_run.png"):
        assert (out / name).stat().st_size > 10_000


def test_an_interruption_leaves_what_was_finished_and_the_next_run_goes_on(
    study, tmp_path, monkeypatch, capsys
):
    real, built = mpfjax.running.studies.monte_carlo, []

    def interrupted(keys, filter, *rest, **options):
        built.append(filter.num_particles)
        if filter.num_particles == 40:
            raise KeyboardInterrupt
        return real(keys, filter, *rest, **options)

    arguments = ["--seeds", "3", "--particles", "20", "40", "--out", str(tmp_path)]
    monkeypatch.setattr(mpfjax.running.studies, "monte_carlo", interrupted)
    assert benchmark.main(arguments) == 130
    written = json.loads((tmp_path / "score_vs_particles.json").read_text())
    names = [(entry["filter"], entry["particles"]) for entry in written["results"]]
    assert names == [("pf", 20), ("mpf", 20), ("guided_mpf", 20)]
    assert "interrupted" in capsys.readouterr().err
    assert benchmark.main(arguments) == 2
    assert "unfinished holds 3 finished cells of 2" in capsys.readouterr().err
    assert benchmark.main([*arguments, "--resume", "--seed", "1"]) == 2
    assert "holds another study (keys is" in capsys.readouterr().err

    def noted(keys, filter, *rest, **options):
        built.append(filter.num_particles)
        return real(keys, filter, *rest, **options)

    built.clear()
    monkeypatch.setattr(mpfjax.running.studies, "monte_carlo", noted)
    assert benchmark.main([*arguments, "--resume"]) == 0
    assert "taken over, 3 to run" in capsys.readouterr().out
    assert built == [40, 40, 40]
    assert json.loads((tmp_path / "score_vs_particles.json").read_text()) == study[1]
    assert {path.name for path in tmp_path.iterdir()} == {path.name for path in study[0].iterdir()}


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--seeds", "0"], "--seeds"),
        (["--particles", "1"], "--particles"),
        (["--filters", "kalman"], "--filters"),
    ],
)
def test_bad_options_are_refused_by_name(arguments, named, capsys):
    with pytest.raises(SystemExit):
        benchmark.main(arguments)
    assert named in capsys.readouterr().err


def test_the_mass_error_is_zero_for_a_filter_that_is_exact():
    exact = np.full(100, 0.5)
    runs = {
        "both": np.ones((2, 100), bool),
        "weight": np.full((2, 100), 0.5),
        "components": np.full((2, 100), 2),
        "mass_above": np.broadcast_to(exact, (2, 100)),
    }
    entry = benchmark.summarise("mpf", 10, runs, exact)
    assert entry["mode_mass_error"] == 0
    runs["mass_above"] = np.broadcast_to(exact + 0.1, (2, 100))
    assert benchmark.summarise("mpf", 10, runs, exact)["mode_mass_error"] == pytest.approx(0.1)


def test_one_data_set_serves_all_seeds():
    truth, observations = benchmark.simulate(2)
    assert jnp.array_equal(observations, benchmark.simulate(2)[1])
    assert not jnp.array_equal(observations, benchmark.simulate(3)[1])
    assert jnp.abs(observations - truth**2).max() < 0.5
