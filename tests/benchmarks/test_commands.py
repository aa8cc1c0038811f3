"""Every command runs with --quick and writes its files, and what they compute is right."""

import importlib
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import mpfjax
from benchmarks import harness
from benchmarks.interacting_objects.partitions import adaptive_partitions, independent_partitions
from benchmarks.masses.models import Bearings, MarginalisedBearings
from benchmarks.masses.scenes import SCENES
from benchmarks.partitioned_sampling.posterior import Window, distance_maps
from benchmarks.peers.__main__ import disagreement
from benchmarks.smoothing.jobs import Linear, Quadratic
from tests.examples import stack, walker
from tests.marking import thorough
from tests.smoothing.exact_smoothers import gaussian_smoother, grid_smoother

# The files that each writes.
COMMANDS = {
    "code_size": "",
    "first_result": "first_result.json",
    "gm_mpf": "gm_mpf.json particle_migration.png effective_sample_size.png rmse.png",
    "hand_written_c": "hand_written_c.json",
    "interacting_objects": "interacting_objects.json interacting_objects.png",
    "likelihood_tuning": "scores.json starts.json optimisations.png labels.json overlaps.png",
    "marginalised": "marginalised.json",
    "masses": "masses.json masses.png",
    "partitioned_sampling": "partitioned_sampling.json uniqueness.png recovery.png recovery.gif "
    "contact_sheet.png",
    "peers": "peers.json peers.png",
    "scaling": "scaling.json scaling.png",
    "score_vs_particles": "score_vs_particles.json score_vs_particles.png typical_run.png",
    "smoothing": "smoothing.json accuracy.png modes.png posteriors.png",
}
QUICKEST = ["code_size"]


def main_of(name):
    """The function that `python -m benchmarks.NAME` calls."""
    module = importlib.import_module(f"benchmarks.{name}")
    if not hasattr(module, "main"):
        module = importlib.import_module(f"benchmarks.{name}.__main__")
    return module.main


@pytest.mark.parametrize("name", [*QUICKEST, *thorough(sorted(COMMANDS.keys() - QUICKEST))])
def test_a_command_runs_and_writes_its_files(name, tmp_path, capsys):
    out = ["--out", str(tmp_path)] if COMMANDS[name] else []
    assert main_of(name)(["--quick", *out]) == 0
    assert capsys.readouterr().out
    for file in COMMANDS[name].split():
        assert (tmp_path / file).stat().st_size > 50, file


# --- the harness --------------------------------------------------------------------------------


@harness.command(sizes=[2])
def example(
    *,
    sizes: Sequence[harness.AtLeast2] = (10, 20),
    pair: tuple[harness.Natural, harness.Natural] | None = None,
    kinds: Annotated[Sequence[Annotated[str, ("one", "two")]], "*"] = ("one",),
    weigh: bool = True,
    out: Path = Path("results"),
) -> int:
    """An example.

    - `sizes`: N, of
      all.
    """
    print(sizes, pair, kinds, weigh, out)
    return sum(sizes)


def test_options_are_those_of_the_signature(capsys):
    assert example([]) == 30
    assert example(["--quick"]) == 2
    assert example(["--quick", "--sizes", "3", "4"]) == 7
    given = ["--pair", "0", "1", "--kinds", "--no-weigh", "--out", "there"]
    assert example(given) == 30
    assert capsys.readouterr().out.splitlines()[-1] == "(10, 20) [0, 1] [] False there"
    for wrong, word in (
        (["--sizes", "1"], "from 2"),
        (["--pair", "1"], "expected 2"),
        (["--kinds", "three"], "invalid choice"),
    ):
        with pytest.raises(SystemExit, match="2"):
            example(wrong)
        assert word in capsys.readouterr().err
    with pytest.raises(SystemExit, match="0"):
        example(["--help"])
    assert "N, of all. (default: (10, 20))" in " ".join(capsys.readouterr().out.split())


def test_errors_and_intervals_are_those_of_scipy():
    values = np.random.default_rng(0).normal(1, 2, 40)
    mean, error = harness.mean_and_error(values)
    assert (mean, error) == pytest.approx((values.mean(), stats.sem(values)))
    assert harness.rms_and_error(values**2)[0] == pytest.approx(np.sqrt(np.mean(values**2)))
    others = values - 0.1 * values**2
    expected = stats.ttest_rel(values, others).statistic
    assert harness.worse(values, others) == pytest.approx(expected)
    interval = stats.binomtest(7, 20).proportion_ci(method="wilson")
    assert harness.wilson(7 / 20, 20) == pytest.approx([interval.low, interval.high])


def test_turns_are_timed_but_for_the_first_and_tables_have_dashes():
    clock, calls = iter(np.arange(100.0) ** 2), []
    runs = {name: lambda turn, name=name: calls.append((turn, name)) for name in "ab"}
    taken = harness.turns(runs, 3, clock=lambda: next(clock))
    assert sorted(calls) == [(turn, name) for turn in range(4) for name in "ab"]
    # The first two calls begin at 0 and 1, those that count are timed from begin to end.
    assert np.concatenate(list(taken.values())).sum() == sum(2 * k + 1 for k in range(2, 14, 2))
    assert harness.ratio(np.array([2.0, 9.0, 4.0]), np.array([1.0, 3.0])) == 2.5
    columns = {"n": "{n}", "x": "{x:.1f}"}
    lines = harness.table(columns, [{"n": 1, "x": 0.25}, {"n": 2, "x": None}]).splitlines()
    assert [line.split() for line in lines[2:]] == [["1", "0.2"], ["2", "-"]]


# --- what commands compute ----------------------------------------------------------------------


def test_smoothed_truths_are_those_of_one_large_gaussian_and_of_another_grid():
    job = Linear(6, 1)
    model = type("Model", (), {
        "A": [[job.a]], "Q": [[job.q**2]], "H": [[1.0]], "R": [[job.r**2]], "m0": [0.0],
        "P0": [[job.p**2]],
    })  # fmt: skip
    means, covariance = gaussian_smoother(model, job.observations[:, None])
    x = means[:, 0]
    assert job.exact == pytest.approx(np.mean(np.diagonal(covariance, 1) + x[:-1] * x[1:]))
    job, grid = Quadratic(6, 1), np.linspace(-4, 4, 701)
    log_initial = np.where(np.abs(grid) <= job.width, 0.0, -np.inf)
    log_transition = -0.5 * ((grid[None] - grid[:, None]) / job.sigma_x) ** 2
    log_likelihoods = -0.5 * ((job.observations[:, None] - grid**2) / job.sigma_y) ** 2
    _, pairs = grid_smoother(log_initial, log_transition, log_likelihoods)
    expected = np.mean(np.einsum("sij,i,j->s", pairs, grid, grid))
    assert job.exact == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize(
    "name", ["bearings", *thorough(["corridor", "mirror", "terrain", "jumps"])]
)
def test_noise_and_draws_have_one_law(name):
    """Of x_0 and of a step: the draws of the model and those from noise, by their moments."""
    model, n = SCENES[name][0](2, 0).model, 20_000
    keys = jax.random.split(jax.random.key(0), 4)
    start = model.sample_initial(keys[0], n)
    noise = jax.random.normal(keys[1], (n, model.initial_noise_dimension))
    step_noise = jax.random.normal(keys[3], (n, model.noise_dimension))
    drawn = start, model.sample_transition(keys[2], start)
    made = model.initial_from_noise(noise), model.transition_from_noise(step_noise, start)
    for one, other in zip(jax.tree.leaves(drawn), jax.tree.leaves(made), strict=True):
        one, other = np.asarray(one, float), np.asarray(other, float)
        error = np.sqrt((one.var(axis=0) + other.var(axis=0)) / n)
        assert (np.abs(one.mean(axis=0) - other.mean(axis=0)) <= 4 * error + 1e-9).all()
        np.testing.assert_allclose(one.std(axis=0), other.std(axis=0), rtol=0.05, atol=1e-9)


def test_the_velocity_of_the_bearings_is_marginalised_exactly():
    """Both filters, one with drawn velocities, have the same evidence."""
    keys = jax.random.split(jax.random.key(0), 200)
    observations = Bearings().simulated(4, 0)
    one, other = (
        np.exp(np.asarray(mpfjax.monte_carlo(
            keys, mpfjax.particle_filter(model, 500), observations, harness.nothing
        ).log_marginal_likelihood))
        for model in (Bearings(), MarginalisedBearings())
    )  # fmt: skip
    error = np.hypot(one.std(), other.std()) / np.sqrt(len(keys))
    assert error < 0.1 * one.mean()
    assert abs(one.mean() - other.mean()) < 4 * error


def test_maps_are_counted_pixel_by_pixel():
    """Σ over the bands of 1 - Σ_b sqrt(h_b h_ref,b), of boxes inside the frame and not."""
    rng = np.random.default_rng(0)
    bins, sides = rng.integers(0, 4, (9, 11)), (3, 4)
    references = rng.dirichlet(np.ones(4), size=(1, 2))
    window = Window.whole(bins, sides)
    found = distance_maps(bins, references, sides, window)[0]
    for top, left in ((2, 5), (-1, -2), (7, 9), (-4, 0)):
        expected = 0.0
        for part in range(2):
            rows = slice(max(top + 2 * part, 0), max(top + 2 * part + 2, 0))
            pixels = bins[rows, max(left, 0) : max(left + 3, 0)].ravel()
            shares = np.bincount(pixels, minlength=4) / max(len(pixels), 1)
            expected += 1 - np.sqrt(shares * references[0, part]).sum()
        place = found[top - window.top, left - window.left]
        assert place == pytest.approx(expected, abs=1e-5)


def made_up(log_likelihood=-10.0, size=50.0, spread=0.3):
    """Twenty runs around these numbers; log E[Ẑ] is the given log-likelihood."""
    noise = np.random.default_rng(0).standard_normal((2, 20))
    noise = (noise - noise.mean(axis=1, keepdims=True)) / noise.std(axis=1, ddof=1, keepdims=True)
    return {
        "log_likelihoods": log_likelihood - spread**2 / 2 + spread * noise[0],
        "effective_sample_sizes": size + 0.5 * noise[1],
    }


@pytest.mark.parametrize(
    ("found", "reference", "reason"),
    [
        (made_up(log_likelihood=-11), made_up(), "mean log likelihoods -11"),
        (made_up(size=53), made_up(), "mean effective sample sizes 53, not 50"),
        (made_up(log_likelihood=-11), made_up(log_likelihood=-11), "exactly -10"),
        (made_up(log_likelihood=np.nan), made_up(), "not finite"),
    ],
)
def test_a_library_with_other_numbers_is_refused(found, reference, reason):
    assert reason in disagreement(found, reference, exact=-10.0)
    assert disagreement(made_up(-10.1, 50.2), made_up(), exact=-10.0) is None


@pytest.mark.thorough
@pytest.mark.parametrize("make", [independent_partitions, adaptive_partitions])
def test_objects_that_never_meet_are_proposed_exactly(make):
    """Beside the exact evidence of two walkers."""
    path = jnp.array([[0.2, 1.6], [0.9, 1.4], [1.2, 1.2]])[:, :, None]
    model = mpfjax.MultiObjectModel(stack([walker(0.0), walker(2.0)]), 2)
    keys = jax.random.split(jax.random.key(0), 400)
    runs = mpfjax.monte_carlo(keys, make(model, 50), path, harness.nothing)
    exact = sum(
        mpfjax.exact.kalman_filter(walker(start), path[:, k]).log_marginal_likelihood
        for k, start in enumerate((0.0, 2.0))
    )
    ratios = np.exp(np.asarray(runs.log_marginal_likelihood) - float(exact))
    assert abs(ratios.mean() - 1) < 4 * ratios.std() / np.sqrt(len(ratios)) < 0.1
