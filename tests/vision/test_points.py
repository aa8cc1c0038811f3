"""Points in the place of boxes, and vectors beside boxes, on simulations whose truth is known."""

import numpy as np
import pytest

from mpfjax.vision import Detections, ObjectTracker, track
from mpfjax.vision.tracking.track import online_rows
from tests.marking import weekly


@pytest.mark.parametrize("scale", [1.0, 1e-3])
def test_points_among_false_ones_in_any_unit(scale):
    """Nine in ten plots, three false ones a scan, targets that turn at random; at one a second."""
    rng = np.random.default_rng(1)
    place, velocity = rng.uniform(0, 1000, (5, 2)), rng.uniform(-8, 8, (5, 2))
    rows, truth = [], []
    for number in range(1, 61):
        velocity = velocity + 0.3 * rng.standard_normal((5, 2))
        place = place + velocity
        truth.append(place)
        seen = place[rng.uniform(size=5) < 0.9]
        plots = seen + 5 * rng.standard_normal(seen.shape)
        plots = np.concatenate([plots, rng.uniform(-200, 1200, (rng.poisson(3), 2))])
        rows += [[number, -1, *plot, 1.0] for plot in scale * plots]
    tracker = ObjectTracker(40, frames_per_second=1, point_deviation=5 * scale)
    followed, false = np.zeros((60, 5), int), 0
    for number, tracks in enumerate(track(None, np.array(rows), tracker)):
        table = online_rows(tracks, described=True)
        assert table.shape[1] == 6
        if not len(table):
            continue
        points = table[:, 2:4] / scale
        apart = np.linalg.norm(truth[number][:, None] - points, axis=2)
        near = apart.min(axis=1, initial=np.inf) < 20
        followed[number, near] = table[apart.argmin(axis=1)[near], 1]
        false += int((apart.min(axis=0, initial=np.inf) > 20).sum())
    late = followed[10:]
    assert (late > 0).mean() > 0.85
    switches = sum((np.diff(each[each > 0]) != 0).sum() for each in late.T)
    assert switches <= 3
    assert false / 60 < 1


def right_after_a_meeting(crosses, with_vectors, seed):
    """Whether two who walk up to each other and stand together keep their identities after it.

    They walk on, or turn back: their motion does not say which, and vectors do.
    """
    rng = np.random.default_rng(seed)
    codes, kept = rng.standard_normal((2, 8)), []
    end = np.linspace(99, 198, 34) if crosses else np.linspace(99, 0, 34)
    tracker = ObjectTracker(4, frames_per_second=25)
    state = tracker.init()
    for x in np.concatenate([np.linspace(0, 99, 34), np.full(25, 99.0), end]):
        corners = np.array([[x, 50.0], [200 - x, 52.0]]) + 0.5 * rng.standard_normal((2, 2))
        boxes = np.c_[corners, np.tile([20.0, 40.0], (2, 1))]
        seen, order = codes + 0.5 * rng.standard_normal((2, 8)), rng.permutation(2)
        given = Detections(boxes[order], vectors=seen[order] if with_vectors else None)
        state, tracks = tracker.step(None, state, None, given)
        kept.append(dict(zip(order[tracks.detections], tracks.identities, strict=True)))
    return kept[20] == kept[-1]


@pytest.mark.exactness
@pytest.mark.parametrize("with_vectors", [*weekly([False]), True])
def test_look_alikes_in_motion_are_told_apart_by_their_vectors(with_vectors):
    kept = [right_after_a_meeting(way, with_vectors, seed) for way in (0, 1) for seed in range(4)]
    assert all(kept) == with_vectors
