"""What commands compute beside filters, draw, and measure: against exact answers, and by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import tracking_quality as quality
from benchmarks.coverage import coverage, covers
from benchmarks.localisation.filters import AdaptiveMonteCarlo
from benchmarks.masses.scenes import SCENES
from benchmarks.partitioned_sampling.posterior import distance_maps
from benchmarks.visual_tracking.following import Snapshot, track_rows
from mpfjax.metrics.tracking_scores import overlap


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


G = jnp.array([10.0, 20.0, 40.0, 20.0])


def box(x, y, w, h):
    return jnp.array([x, y, w, h], float)


@pytest.mark.parametrize(
    "estimate", [box(20, 25, 0, 10), box(20, 25, -10, -10), box(jnp.nan, 25, 10, 10)]
)
def test_a_box_without_area_or_place_tracks_nothing(estimate):
    assert not quality.track_state(estimate, G)
    assert quality.precision(estimate, G) == quality.recall(estimate, G) == 0


def test_areas_are_those_of_the_overlap():
    """Which is the shared area over that of both."""
    rng = np.random.default_rng(0)
    boxes = np.concatenate([rng.uniform(0, 30, (50, 2, 2)), rng.uniform(1, 25, (50, 2, 2))], axis=2)
    area, ratio = boxes[..., 2:].prod(axis=2), np.diag(overlap(boxes[:, 0], boxes[:, 1]))
    shared = ratio * area.sum(axis=1) / (1 + ratio)
    estimates, truth = jnp.asarray(boxes[:, 0]), jnp.asarray(boxes[:, 1])
    np.testing.assert_array_equal(quality.track_state(estimates, truth), shared > 0)
    for measure, of in ((quality.precision, area[:, 0]), (quality.recall, area[:, 1])):
        np.testing.assert_allclose(measure(estimates, truth), shared / of, rtol=1e-4, atol=1e-6)


# Four runs of five frames: throughout, lost and back, lost for good, back only just.
STATES = jnp.array([[1, 1, 1, 1, 1], [1, 0, 0, 1, 1], [1, 1, 0, 0, 0], [1, 0, 0, 0, 1]], bool)


def test_rates_by_hand():
    assert float(quality.success_rate(STATES)) == 0.25
    assert float(quality.recovery_rate(STATES)) == 0.75
    assert float(quality.recovery_rate(STATES, num_last=2)) == 0.5
    both = jnp.stack([STATES, ~STATES], axis=2)
    np.testing.assert_array_equal(quality.success_rate(both), [0.25, 0.0])
    np.testing.assert_array_equal(quality.recovery_rate(both), [0.75, 0.25])


def test_hypotheses_differ_where_any_number_does():
    states = np.zeros((6, 3, 2))
    states[:, 0] = np.arange(12).reshape(6, 2)
    states[:, 1, 1] = [1, 2, 1, 2, 1, 9]
    np.testing.assert_allclose(
        quality.uniqueness(jnp.asarray(states)), [1.0, 3 / 6, 1 / 6], rtol=1e-6
    )


def snapshots(references=True):
    """Three components in three frames of one run; the second dies and its label is used again."""
    active = np.array([[1, 1, 0], [1, 0, 0], [1, 1, 1]], bool)
    owners = np.array([[0, 1, 5], [0, 1, 5], [0, 0, 1]])
    return [
        Snapshot(
            means=np.array([[[10.0 + m, 20.0 + frame, 4.0, 6.0] for m in range(3)]]),
            active=active[frame][None],
            points=None,
            labels=None,
            references=owners[frame][None] if references else None,
        )
        for frame in range(3)
    ]


def test_a_track_is_a_life_of_a_component():
    rows = track_rows(snapshots(references=False), first=7)
    assert rows[:, :2].tolist() == [[7, 1], [7, 2], [8, 1], [9, 1], [9, 3], [9, 4]]
    np.testing.assert_allclose(rows[1], [7, 2, 9.0, 17.0, 4.0, 6.0])


def test_or_a_hypothesis_about_one_of_the_given_boxes():
    rows = track_rows(snapshots(), by_reference=True)
    assert rows[:, :2].tolist() == [[1, 1], [1, 2], [2, 1], [3, 1], [3, 1], [3, 2]]
