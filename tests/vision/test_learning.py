"""What the tracker learns, against exact filters, brute force and noises that are known."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax.exact import kalman_filter
from mpfjax.vision import Detections, ObjectTracker
from mpfjax.vision.tracking.camera import CameraState
from mpfjax.vision.tracking.gaussian import Gaussian
from mpfjax.vision.tracking.lives import Coasting, Duplicates, Lives, Spans
from mpfjax.vision.tracking.scores import ScoreState, rising
from mpfjax.vision.tracking.tracker import advanced

M = 4


def test_a_box_is_filtered_as_by_the_kalman_filter():
    """Along x and y of a box whose size is steady, with noises that are given."""
    rng = np.random.default_rng(0)
    seen = np.array([30.0, 60, 3, 3.5]) + rng.normal(0, 0.05, (6, 4)) * [1, 1, 0, 0]
    error, place, velocity = 0.3, 0.02, 0.005
    now = Gaussian.begun(jnp.asarray(seen[:1]), jnp.full((1, 4), 0.3), jnp.full((1, 4), 0.1))
    unit, got = np.asarray(now.unit[0], float), []
    for row in seen[1:]:
        predicted = now.predicted(jnp.full((1, 4), place), jnp.full((1, 4), velocity))
        now, _, _ = predicted.updated(jnp.asarray(row[None]), jnp.full((1, 4), error))
        got.append(np.stack([moment[0] for moment in now]))
    for k in range(2):
        model = mpfjax.LinearGaussianModel(
            A=np.array([[1.0, 1], [0, 1]]),
            Q=np.diag([(unit[k] * place) ** 2, (unit[k] * velocity) ** 2]),
            H=np.array([[1.0, 0.0]]),
            R=np.array([[error**2]]),
            m0=np.array([seen[0, k], 0.0]),
            P0=np.diag([0.3**2, 0.1**2]),
        )
        run = kalman_filter(model, jnp.asarray(seen[1:, [k]]))
        moments = np.stack(got)[:, :, k]
        np.testing.assert_allclose(moments[:, :2], run.means, rtol=1e-4, atol=1e-4)
        expected = np.asarray(run.covariances)[:, *np.triu_indices(2)]
        np.testing.assert_allclose(moments[:, 2:], expected, rtol=1e-3, atol=1e-5)


def test_mixed_moments_are_those_of_the_mixture_of_both():
    a = Gaussian(*(np.full((1, 4), x, np.float32) for x in (1.0, 2.0, 1.0, 0.5, 0.8)))
    b = Gaussian(*(np.full((1, 4), x, np.float32) for x in (3.0, -1.0, 2.0, 0.1, 0.3)))
    mixed = [moment[0, 0] for moment in a.mixed_with(b, jnp.full((1, 1), 0.3))]
    means, shares = np.array([[1.0, 2.0], [3.0, -1.0]]), np.array([0.3, 0.7])
    within = np.array([[[1.0, 0.5], [0.5, 0.8]], [[2.0, 0.1], [0.1, 0.3]]])
    off = means - shares @ means
    cov = np.einsum("k,kij->ij", shares, within + off[:, :, None] * off[:, None])
    np.testing.assert_allclose(mixed, [*(shares @ means), *cov[np.triu_indices(2)]], rtol=1e-5)


# --- noises --------------------------------------------------------------------------------

TRACKER = ObjectTracker(M, frames_per_second=25)
FOLLOW = jax.jit(lambda xs: jax.lax.scan(lambda s, x: advanced(TRACKER, s, x), TRACKER.init(), xs))


def followed(boxes_of_frames):
    """The state after these boxes by their centres, one for each object in each frame."""
    boxes = np.asarray(boxes_of_frames, np.float32)
    shape, ones = boxes.shape[:2], jnp.ones(boxes.shape[:2])
    far = jnp.tile(jnp.array([-1e6, -1e6, 1e6, 1e6]), (len(boxes), 1))
    rows = jnp.broadcast_to(jnp.arange(shape[1], dtype=jnp.int32), shape)
    labels = jnp.zeros(shape, jnp.int32)
    found = Detections(jnp.asarray(boxes[0]), ones[0] > 0, ones[0], rows[0], far[0], labels[0])
    leaves = jnp.asarray(boxes), ones > 0, ones, rows, far, labels
    return FOLLOW(jax.tree.unflatten(jax.tree.structure(found), leaves))[0]


@pytest.mark.parametrize("error", [0.012, 0.04, 0.12])
def test_the_detectors_errors_are_learned_in_a_second(error):
    """Four objects that walk steadily, and detections that err by so much of a box."""
    rng = np.random.default_rng(0)
    start, pace = 400 * np.arange(M)[:, None] + np.ones(2), rng.normal(0, 3, (M, 2))
    frames = []
    for t in range(40):
        noise = rng.normal(0, error, (M, 4))
        size = np.array([50.0, 120]) * np.exp(noise[:, 2:])
        frames.append(np.c_[start + pace * t + noise[:, :2] * [50, 120], size])
    noises = followed(frames).noise.noises
    assert (np.asarray(noises.errors) < 2 * error).all()
    assert (np.asarray(noises.errors) > error / 2).all()
    assert (np.asarray(noises.velocity) < 0.01).all()  # nothing but the detector errs


def test_who_moves_at_random_is_not_taken_for_a_bad_detector():
    rng = np.random.default_rng(0)
    walk = np.cumsum(np.cumsum(rng.normal(0, 0.03, (50, M, 2)), axis=0), axis=0) * [50, 120]
    paths = walk + 900 * np.arange(M)[None, :, None]
    size = np.tile([50.0, 120], (50, M, 1))
    noises = followed(np.concatenate([paths, size], axis=2)).noise.noises
    assert (np.asarray(noises.velocity)[:2] > 0.01).all()
    assert (np.asarray(noises.errors)[:2] < 0.04).all()
    assert (np.asarray(noises.velocity)[2:] < 0.006).all()


# --- the camera ----------------------------------------------------------------------------


@pytest.mark.parametrize("sigma", [0.02, 0.2])
@pytest.mark.parametrize("num_objects", [2, 8])
def test_the_mean_product_of_innovations_is_the_cameras_variance(sigma, num_objects):
    """Objects err on their own by half a box, which must not be taken for the camera's motion."""
    rng = np.random.default_rng(0)
    places = np.c_[100.0 * np.arange(num_objects), np.zeros((num_objects, 3))]
    rows = jnp.asarray(places, jnp.float32)
    small = jnp.full_like(rows, 0.02)
    predicted = Gaussian(rows, 0 * rows, small, small, small)
    cost = jnp.where(jnp.eye(num_objects, dtype=bool), -1.0, 1.0)
    camera = jax.tree.map(jnp.asarray, CameraState.initial())
    known, gone = jnp.asarray(False), jnp.zeros((1, 2))
    step = jax.jit(
        lambda camera, seen: camera.after(
            predicted, gone, known, cost, jnp.full(4, 0.1), seen, jnp.ones(2)
        )
    )
    kept = []
    for _ in range(600):
        gaps = rng.normal(0, sigma, 2) + rng.normal(0, 0.1, (num_objects, 2))
        camera, _ = step(camera, jnp.asarray(places + np.pad(gaps, [(0, 0), (0, 2)]), jnp.float32))
        kept.append(np.asarray(camera.deviations) ** 2)
    # The mean of a few hundred products, of which a thirtieth is forgotten in each frame.
    learned = np.sqrt(np.mean(kept[200:]))
    assert learned == pytest.approx(sigma, rel=0.35 if sigma > 0.1 else 1.2)


def test_a_shift_of_all_is_the_cameras_and_that_of_one_is_its_own():
    rows = jnp.asarray(np.c_[100.0 * np.arange(5), np.zeros((5, 3))], jnp.float32)
    small = jnp.full_like(rows, 1e-4)
    predicted = Gaussian(rows, 0 * rows, small, small, small)
    cost = jnp.where(jnp.eye(5, dtype=bool), -1.0, 1.0)
    camera = CameraState(jnp.full(2, 0.5), jnp.full(2, 0.5), jnp.asarray(30.0))
    seen = rows + jnp.array([[0.7, 0, 0, 0]])
    seen = seen.at[2, 1].add(3.0)
    known = jnp.asarray(False)
    _, shift = camera.after(
        predicted, jnp.zeros((1, 2)), known, cost, jnp.zeros(4), seen, jnp.ones(2)
    )
    np.testing.assert_allclose(shift, [0.7, 0.0], atol=0.02)


# --- scores, coasting, duplicates --------------------------------------------------------------


def test_rising_is_the_nearest_sequence_that_does_not_fall():
    """Against all ways to cut five numbers into blocks of equal values."""
    rng = np.random.default_rng(0)
    fit = jax.jit(rising)
    for _ in range(10):
        values, weights = rng.normal(size=5), rng.uniform(0.5, 2, 5)
        best = None
        for cuts in itertools.product([0, 1], repeat=4):
            block = np.cumsum([0, *cuts])
            means = [np.average(values[block == b], weights=weights[block == b]) for b in block]
            loss = np.sum(weights * (values - means) ** 2)
            if (np.diff(means) >= -1e-12).all() and (best is None or loss < best[0]):
                best = loss, means
        np.testing.assert_allclose(
            fit(jnp.float32(values), jnp.float32(weights)), best[1], atol=1e-5
        )


@jax.jit
def after_all(frames, lasting):
    stronger, overlaps = jnp.zeros((4, 4), bool), jnp.zeros((4, 4))

    def step(state, found):
        return state.after(found, stronger, overlaps, jnp.zeros((1, 2)), lasting), None

    start = jax.tree.map(jnp.asarray, ScoreState.initial(8))
    return jax.lax.scan(step, start, frames)[0]


def scored(frames, lasting=50):
    """The state after frames of (places of boxes of 10 x 10, scores)."""
    found = []
    for places, scores in frames:
        corners = np.array([[*place, 10, 10] for place in places], float)
        found.append(Detections.from_boxes(corners, 4, np.asarray(scores, float)))
    return after_all(jax.tree.map(lambda *leaves: np.stack(leaves), *found), jnp.int32(lasting))


def test_scores_of_chains_that_become_sure_are_strong_and_of_those_that_end_are_not():
    """One that comes nearer, with rising scores; and flashes at ever other places."""
    rng = np.random.default_rng(0)
    near = [[((5, 5),), [0.3 + 0.7 * (t % 40) / 40]] for t in range(120)]
    assert float(scored(near).strong) < 0.4
    flashes = [[((5, 5), tuple(rng.uniform(100, 900, 2))), [1.0, 0.7]] for t in range(120)]
    assert float(scored(flashes).strong) > 0.7
    far = [[((5, 5), (300, 300)), [1.0, 0.3]] for t in range(120)]
    assert float(scored(far, lasting=1000).strong) == pytest.approx(0.5, abs=0.05)
    assert float(scored(far, lasting=50).strong) < 0.35


@pytest.mark.parametrize("score", [-2.0, 0.3, 7.0])
def test_equal_scores_are_all_strong(score):
    state = scored([[((5, 5), (50, 50)), [score, score]]] * 200)
    assert float(state.strong) <= score
    assert float(state.weak) <= score


def test_predictions_are_shown_for_as_long_as_they_were_right():
    """At 25 frames a second: a tenth of one before anything is known."""
    spans = Spans.at(jnp.asarray(25.0))
    coasting = jax.tree.map(jnp.asarray, Coasting.initial())
    assert int(coasting.longest(spans)) == 2
    lives = jax.tree.map(jnp.asarray, Lives.initial(3))
    gone = lives._replace(unseen=jnp.array([10, 10, 10]), confirmed=jnp.ones(3, bool))
    now = gone._replace(identities=jnp.array([1, 2, 3], jnp.int32))
    seen, after = jnp.ones(3, bool), jax.jit(Coasting.after)
    for _ in range(20):
        right = after(coasting, gone, now, seen, seen, spans)
        wrong = after(coasting, gone, now, seen, ~seen, spans)
        assert int(right.longest(spans)) >= 5
        assert int(wrong.longest(spans)) == 0
    nobody = gone._replace(identities=jnp.zeros(3, jnp.int32))
    ended = after(coasting, gone, nobody, ~seen, seen, spans)
    assert float(jnp.sum(ended.wrong)) == 3 * 11
    assert not ended.wrong[9:].any()  # of 20 bins for 25 frames


def test_who_never_leaves_a_neighbour_before_it_ends_is_a_double():
    """Others that began beside an older one decide: most of them ended there, or went away."""
    together = jnp.array([[1.0, 0.4], [0.4, 1.0]])
    apart, seen = jnp.eye(2), jnp.ones(2, bool)
    after = jax.jit(Duplicates.after)

    def many(overlaps_before_the_end, ends):
        duplicates = jax.tree.map(jnp.asarray, Duplicates.initial(2))
        for name in range(2, 14):
            names = jnp.array([1, name], jnp.int32)
            duplicates = after(duplicates, names, jnp.array([name > 2, False]), seen, together)
            assert np.asarray(duplicates.elders).tolist() == [0, 1]
            begun = duplicates
            duplicates = after(duplicates, names, seen, seen, overlaps_before_the_end)
            if ends:
                gone = jnp.array([1, 0], jnp.int32)
                duplicates = after(duplicates, gone, jnp.array([True, False]), seen, together)
        return begun

    assert np.asarray(many(together, ends=True).doubtful).tolist() == [False, True]
    assert not np.asarray(many(apart, ends=True).doubtful).any()
