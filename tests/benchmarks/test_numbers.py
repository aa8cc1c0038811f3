"""What commands compute beside filters: against exact answers, and counted by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.coverage import coverage, covers
from benchmarks.localisation.filters import AdaptiveMonteCarlo
from benchmarks.masses.scenes import SCENES
from benchmarks.partitioned_sampling.posterior import distance_maps


@pytest.mark.exactness
@pytest.mark.parametrize("name", ["corridor", "mirror", "jumps"])
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


@pytest.mark.parametrize("spread", [0.1, 1.0, 10.0])
def test_amcl_draws_one_by_one_until_there_are_enough_for_the_bins(spread):
    """Beside the loop of Fox (2003), table 1, with the least and the most of ROS."""
    move, occupied, number = AdaptiveMonteCarlo(), set(), 5000
    drawn = spread * np.random.default_rng(0).normal(size=(5000, 3)).astype(np.float32)
    for k, pose in enumerate(np.floor(drawn / np.array(move.bins, np.float32)), 1):
        occupied.add(tuple(pose))
        more = max(len(occupied) - 1, 1)
        ratio = 2 / (9 * more)
        enough = more / (2 * 0.05) * (1 - ratio + np.sqrt(ratio) * 0.99) ** 3
        if len(occupied) > 1 and k > min(max(enough, 2000), 5000):
            number = k
            break
    assert int(move.number(jnp.asarray(drawn))) == number


def test_maps_are_counted_pixel_by_pixel():
    """Σ over the bands of 1 - Σ_b sqrt(h_b h_ref,b), of boxes inside the frame and not."""
    rng = np.random.default_rng(0)
    bins, sides = rng.integers(0, 4, (9, 11)), (3, 4)
    references = rng.dirichlet(np.ones(4), size=(1, 2))
    found = distance_maps(bins, references, sides)[0]
    for top, left in ((2, 5), (-1, -2), (7, 9), (-4, 0)):
        expected = 0.0
        for part in range(2):
            rows = slice(max(top + 2 * part, 0), max(top + 2 * part + 2, 0))
            pixels = bins[rows, max(left, 0) : max(left + 3, 0)].ravel()
            shares = np.bincount(pixels, minlength=4) / max(len(pixels), 1)
            expected += 1 - np.sqrt(shares * references[0, part]).sum()
        place = found[top + sides[1], left + sides[0]]
        assert place == pytest.approx(expected, abs=1e-5)


# --- scores of tracks, and detections -----------------------------------------------------------


def row(frame, id, x, y=0.0):
    return [frame, id, x, y, 10.0, 20.0]


@pytest.mark.exactness
def test_coverage_strays_and_swaps_by_hand():
    objects = np.array([row(t, id, 100 * id) for t in (1, 2, 3, 4) for id in (1, 2)])
    places = ((1, 7, 100), (1, 8, 200), (2, 7, 100), (2, 8, 500), (3, 8, 200), (4, 9, 200))
    tracks, others = np.array([row(*place) for place in places]), np.array([row(2, 3, 504)])
    result = coverage(tracks, objects, others)
    assert (result.all_covered, result.on_object, result.on_other) == (0.25, 5 / 6, 1 / 6)
    assert result.id_swaps == 1
    # |dx| < 0.75 w and |dy| < 0.5 h of the object, strictly, whatever the track's own size.
    centres = [(5 + 7.4, 10), (5 + 7.5, 10), (5, 10 + 9.9), (5, 10 + 10), (5 - 7.4, 10 - 9.9)]
    boxes = np.array([(x - 2, y - 3, 4, 6) for x, y in centres])
    reached = covers(boxes, np.array([[0.0, 0, 10, 20]]))[:, 0]
    assert reached.tolist() == [True, False, True, False, True]
