"""The benchmark of interacting objects: its scenes, its rates, and a short study."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import binomtest

import mpfjax
from benchmarks.interacting_objects import __main__ as benchmark
from benchmarks.interacting_objects import scenes
from benchmarks.interacting_objects.methods import estimates
from benchmarks.interacting_objects.partitions import adaptive_partitions, independent_partitions
from benchmarks.interacting_objects.results import wilson
from tests.examples import stack, walker

KEY = jax.random.key(0)


def test_the_lost_object_comes_back_where_the_constants_say():
    scene = scenes.lost_object(KEY)
    last, back = scenes.LOST.start - 1, scenes.LOST.stop
    path = np.asarray(scene.places[:, 3])
    assert np.linalg.norm(path[back] - path[last]) == pytest.approx(scenes.JUMP, rel=1e-4)
    own = np.asarray(scene.seen["heights"])[:, 3, 3]
    assert (own[scenes.LOST] == 0).all()
    assert (own == 1).sum() == scenes.NUM_FRAMES - (back - scenes.LOST.start)


def test_the_distracter_covers_its_object_and_leads_away():
    scene = scenes.distracted_object(KEY)
    places, heights = scene.seen["places"][:, 0], scene.seen["heights"][:, 0]
    there = np.flatnonzero(heights[:, -1])
    assert there.tolist() == list(range(3, 9))
    gaps = np.linalg.norm(places[:, -1] - scene.places[3, 0][None], axis=1)
    np.testing.assert_allclose(gaps[there], scenes.LEAD * np.arange(6), atol=1e-3)
    assert float(heights[5, 0]) == pytest.approx(scenes.LIKENESS)


def test_a_pair_passes_without_sharing_a_place():
    places = np.asarray(scenes.crossing_pairs(KEY).places)
    gaps = np.linalg.norm(places[:, 0] - places[:, 1], axis=1)
    assert gaps.min() > 12
    assert gaps[[0, -1]].min() > 70
    start, end = places[[0, -1], 0] - places[[0, -1], 1]
    assert start @ end < 0


def test_medians_count_weights():
    mixture = mpfjax.ParticleMixture(
        particles={"now": jnp.array([[[3.0, 0.0]], [[1.0, 5.0]], [[2.0, 7.0]]])},
        log_weights=jnp.log(jnp.array([0.6, 0.3, 0.1])),
        component_indicators=jnp.zeros(3, jnp.int32),
        ancestor_indices=jnp.arange(3, dtype=jnp.int32),
        num_components=1,
    )
    found = estimates(mixture)
    assert found["median"].tolist() == [[3.0, 0.0]]
    np.testing.assert_allclose(found["mean"], [[2.3, 2.2]], rtol=1e-5)


@pytest.mark.parametrize(("hits", "runs"), [(0, 20), (13, 20), (200, 200)])
def test_intervals_are_wilsons(hits, runs):
    expected = binomtest(hits, runs).proportion_ci(0.95, "wilson")
    low, high = wilson(hits / runs, runs)
    np.testing.assert_allclose([low, high], [expected.low, expected.high], atol=1e-4)


@pytest.mark.thorough
def test_a_short_study(tmp_path, capsys):
    options = ["--runs", "2", "--scenes", "e", "--methods", "ps", "independent", "--seed", "1"]
    assert benchmark.main([*options, "--out", str(tmp_path)]) == 0
    written = json.loads((tmp_path / "interacting_objects.json").read_text())
    methods = [line["method"] for line in written["results"]]
    assert methods == ["ps_best", "ps_mean", "independent"]
    rates = written["results"][0]["recovery"]["median"]
    assert rates["rate"] == max(rates["by_order"])
    assert len(rates["by_order"]) == 4
    assert written["settings"]["seed"] == 1
    assert (tmp_path / "interacting_objects.png").stat().st_size > 0
    assert "PS, best order" in capsys.readouterr().out


def test_bad_options():
    for bad in (["--runs", "0"], ["--scenes", "z"], ["--methods", "luck"]):
        with pytest.raises(SystemExit):
            benchmark.parse(bad)


GRID = np.linspace(-5, 7, 241)
CELL = GRID[1] - GRID[0]
PATH = np.array([[0.2, 1.6], [0.9, 1.4], [1.2, 1.2]])
STRENGTH, RADIUS = 6.0, 2.0
REPULSION = mpfjax.PairwiseRepulsion(STRENGTH, RADIUS)


def log_evidence_of_a_pair(interacts, as_if_independent):
    """log p(y_1..y_3) of two walkers, by quadrature over both; also with marginals multiplied."""

    def normal(x, variance):
        return np.exp(-0.5 * x**2 / variance) / np.sqrt(2 * np.pi * variance)

    transition = normal(GRID[:, None] - 0.9 * GRID[None], 0.4) * CELL
    density = np.outer(normal(GRID, 1.0), normal(GRID - 2.0, 1.0))
    gaps = (GRID[:, None] - GRID[None]) / RADIUS
    psi = np.exp(-STRENGTH * np.maximum(1 - gaps**2, 0) ** 2)
    log_evidence = 0.0
    for first, second in PATH:
        if as_if_independent:
            density = np.outer(density.sum(axis=1), density.sum(axis=0)) * CELL**2
        density = transition @ density @ transition.T
        density *= np.outer(normal(first - GRID, 0.5), normal(second - GRID, 0.5))
        density *= psi if interacts else 1.0
        log_evidence += np.log(density.sum() * CELL**2)
        density /= density.sum() * CELL**2
    return log_evidence


def log_estimates(filter, num_runs):
    keys = jax.random.split(KEY, num_runs)
    seen = jnp.asarray(PATH, jnp.float32)[:, :, None]
    runs = mpfjax.monte_carlo(keys, filter, seen, lambda mixture: None)
    return np.asarray(runs.log_marginal_likelihood, float)


def pair(interaction):
    return mpfjax.MultiObjectModel(stack([walker(0.0), walker(2.0)]), 2, interaction)


def assert_mean_is_one(log_ratios):
    ratios = np.exp(log_ratios)
    error = ratios.std() / np.sqrt(len(ratios))
    assert error < 0.02
    assert abs(ratios.mean() - 1) < 4 * error


def test_objects_near_each_other_are_proposed_exactly():
    """With points this close both keep to their rows, and the joint filter is unbiased."""
    exact = log_evidence_of_a_pair(True, as_if_independent=False)
    filter = adaptive_partitions(pair(REPULSION), 50, num_draws=3)
    assert_mean_is_one(log_estimates(filter, 400) - exact)


@pytest.mark.thorough
def test_objects_that_never_meet_are_proposed_exactly_one_by_one():
    exact = log_evidence_of_a_pair(False, as_if_independent=False)
    for make in (independent_partitions, adaptive_partitions):
        assert_mean_is_one(log_estimates(make(pair(None), 50), 400) - exact)


@pytest.mark.thorough
def test_independent_partitions_multiply_the_marginals():
    """Many particles come to the product of the objects' marginals, which is not the exact law."""
    exact = log_evidence_of_a_pair(True, as_if_independent=False)
    multiplied = log_evidence_of_a_pair(True, as_if_independent=True)
    found = log_estimates(independent_partitions(pair(REPULSION), 40_000), 20)
    error = found.std() / np.sqrt(len(found))
    assert abs(found.mean() - multiplied) < 4 * error
    assert abs(exact - multiplied) > 10 * error
