"""The benchmark of gradients and of tuning does what its help says."""

import json

import numpy as np
import pytest

from benchmarks.likelihood_tuning import __main__ as benchmark
from benchmarks.likelihood_tuning import labels, scores, starts
from benchmarks.likelihood_tuning.quadratic import COARSE_GRID, exact_quadratic


@pytest.mark.thorough
def test_scores_are_written_with_their_bias_and_cost(tmp_path, capsys):
    arguments = ["--parts", "a", "--runs", "10", "--particles", "20", "--filters", "pf"]
    arguments += ["--models", "quadratic", "--estimators", "none", "stop"]
    assert benchmark.main([*arguments, "--out", str(tmp_path)]) == 0
    written = json.loads((tmp_path / "scores.json").read_text())
    cells = {(entry["model"], entry["estimator"]) for entry in written["results"]}
    assert cells == {("quadratic", "none"), ("quadratic", "stop")}
    for entry in written["results"]:
        numbers = len(scores.MODELS[entry["model"]])
        assert all(len(entry[key]) == numbers for key in ("exact", "bias", "deviation"))
        assert entry["cost_in_runs"] > 0
    assert "stop-gradient" in capsys.readouterr().out


def test_derivatives_that_overflow_are_said_to():
    entry = {
        "estimator": "none", "filter": "pf", "particles": 10, "runs": 5,
        "finite_runs": 3, "exact": [1.0], "bias": None, "milliseconds": 1.0, "cost_in_runs": 2.0,
    }  # fmt: skip
    assert "overflows in 2 runs" in scores.as_score_row(entry)


def test_exact_scores_are_those_of_differences():
    both = exact_quadratic(COARSE_GRID)
    point, step = np.log([0.12, 0.12]), 0.01
    for axis, expected in enumerate(both(point)[1]):
        offset = step * np.eye(2)[axis]
        found = (both(point + offset)[0] - both(point - offset)[0]) / (2 * step)
        assert found == pytest.approx(expected, rel=0.01, abs=0.2)


def test_ends_are_compared_with_the_exact_maximum():
    maximum = starts.Maximum(np.log([0.1, 0.2]), np.array([0.1, 0.2]))
    entries = [
        {"start": [0.3, 0.3], "relative_error": error, "end": [0.1, 0.2],
         "standard_errors_over_exact": ratio}
        for error, ratio in (([0.01, -0.02], [1.0, 1.1]), ([0.01, 0.05], None))
    ]  # fmt: skip
    table = starts.as_start_table(entries, maximum)
    assert "1 of 2 end within 3%" in table


@pytest.mark.thorough
def test_tuned_labels_are_judged_on_other_frames(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(labels.LAST_FRAME, "rendered", 8)
    monkeypatch.setattr(labels, "NUM_PARTICLES", 10)
    monkeypatch.setattr(labels, "FILTERS", ("pf",))
    arguments = ["--parts", "c", "--sequences", "rendered", "--label-runs", "2"]
    assert benchmark.main([*arguments, "--label-steps", "2", "--out", str(tmp_path)]) == 0
    written = json.loads((tmp_path / "labels.json").read_text())
    assert [entry["filter"] for entry in written["results"]] == ["pf"]
    for entry in written["results"]:
        assert entry["first_frame"] == 5
        assert entry["lambda"][0] != entry["lambda"][1]
        for kind in labels.KINDS:
            assert 0 < entry["overlap"][kind][0] < 1
            assert len(entry["overlap_by_frame"][kind]) == 4
            assert np.sum(entry["references"][kind]) == pytest.approx(4 * 2 * 3, rel=0.01)
    assert (tmp_path / "overlaps.png").stat().st_size > 0
    assert "last frame's" in capsys.readouterr().out


def test_a_sequence_that_is_not_there_is_left_out(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("MPFJAX_DATA", str(tmp_path))
    arguments = ["--parts", "c", "--sequences", "otb_jogging", "--out", str(tmp_path)]
    assert benchmark.main(arguments) == 2
    assert "otb_jogging left out" in capsys.readouterr().err


def test_overlaps_are_those_of_boxes():
    truth = np.array([[[0.0, 0, 10, 10]]])
    found = labels.overlaps(np.array([[[[5.0, 0, 10, 10]]], [[[20.0, 0, 10, 10]]]]), truth)
    np.testing.assert_allclose(found[:, 0, 0], [1 / 3, 0.0])


@pytest.mark.parametrize(
    ("gain", "said"),
    [((0.1, 0.01), "better"), ((-0.1, 0.01), "worse"), ((0.1, 0.06), "no difference")],
)
def test_the_verdict_asks_for_two_standard_errors(gain, said):
    assert labels.verdict(*gain) == said


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--runs", "0"], "--runs"),
        (["--starts", "0"], "--starts"),
        (["--particles", "1"], "--particles"),
        (["--label-runs", "1"], "--label-runs"),
        (["--sequences", "football"], "--sequences"),
        (["--estimators", "reinforce"], "--estimators"),
    ],
)
def test_bad_options_are_refused_by_name(arguments, named, capsys):
    with pytest.raises(SystemExit):
        benchmark.main(arguments)
    assert named in capsys.readouterr().err
