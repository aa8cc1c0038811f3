"""What figures show: the standard errors of means are those of the sample."""

import numpy as np
import scipy.stats

from mpfjax.plotting import draw_errors_by_size, draw_overlaps, standard_error

RUNS = np.random.default_rng(0).normal(size=(3, 5))


def test_standard_errors_divide_by_n_minus_one():
    np.testing.assert_allclose(standard_error(RUNS), scipy.stats.sem(RUNS, axis=0))
    assert np.isnan(standard_error(RUNS[:1])).all()


def test_bars_and_bands_are_standard_errors():
    by_size = {100: np.abs(RUNS[:, 0]), 200: np.abs(RUNS[:, 1])}
    figure = draw_errors_by_size([("errors", {"pf": by_size})], "error")
    (bars,) = figure.axes[0].containers
    heights = [segment[1, 1] - segment[0, 1] for segment in bars[2][0].get_segments()]
    expected = [2 * scipy.stats.sem(by_size[size]) for size in (100, 200)]
    np.testing.assert_allclose(heights, expected)
    figure = draw_overlaps([("a", {"kind": RUNS}, 1)])
    (band,) = figure.axes[0].collections
    corners = band.get_paths()[0].vertices
    width = [np.ptp(corners[corners[:, 0] == frame, 1]) for frame in (2, 3, 4)]
    np.testing.assert_allclose(width, 2 * scipy.stats.sem(RUNS, axis=0)[1:4])
