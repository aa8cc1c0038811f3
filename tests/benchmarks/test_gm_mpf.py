"""The comparison of PF, GPF, MPF and GM-MPF on two targets."""

import json

import jax
import numpy as np
import pytest

from benchmarks.gm_mpf import __main__ as gm_mpf
from benchmarks.gm_mpf import sizes
from benchmarks.gm_mpf.filters import make_model
from benchmarks.gm_mpf.runs import Collect, Step, held, study
from mpfjax.mixture import ParticleMixture
from mpfjax.vision.boxes.colour_model import BoxState

FILTERS = ["pf", "gm_mpf"]
FRAMES = 4


def few(monkeypatch):
    for name, value in (
        ("TIMED_PARTICLES", 20), ("TIMED_FRAMES", 2), ("WARM_UP", 1),
        ("REFERENCE_PARTICLES", 40), ("REFERENCE_RUNS", 1),
    ):  # fmt: skip
        monkeypatch.setattr(sizes, name, value)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A full run of two filters, with little of everything, on the rendered scene."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        few(monkeypatch)
        monkeypatch.setenv("MPFJAX_DATA", "/nowhere")
        out = tmp_path_factory.mktemp("gm_mpf")
        arguments = ["--frames", f"1:{FRAMES}", "--particles", "20", "--seeds", "2"]
        arguments += ["--filters", "gm_mpf", "pf", "--out", str(out)]
        assert gm_mpf.main(arguments) == 0
    return out


@pytest.fixture(scope="module")
def content(folder):
    return json.loads((folder / "gm_mpf.json").read_text())


def test_every_filter_is_timed(content):
    for timing in ("timing", "timing_std", "timing_quadratic"):
        assert list(content[timing]) == FILTERS
    assert all(time > 0 for time in content["timing"].values())
    assert len(content["profile"]) == 5


def test_errors_are_given_for_each_filter_size_and_target(content):
    assert list(content["rmse"]) == FILTERS
    for by_size in content["rmse"].values():
        assert list(by_size) == ["20"]
        assert np.shape(by_size["20"]) == (2,)
        assert np.isfinite(by_size["20"]).all()
    assert list(content["monte_carlo_error"]) == ["gm_mpf"]
    assert np.shape(content["monte_carlo_error"]["gm_mpf"]["20"]) == (2,)


def test_effective_sample_sizes_lie_within_their_bounds(content):
    for curve in content["n_eff"].values():
        assert len(curve) == FRAMES
        assert 1 <= min(curve) <= max(curve) <= 20


def test_both_held_is_a_share_of_the_seeds(content):
    assert list(content["both_held"]) == FILTERS
    assert set(content["both_held"].values()) <= {0.0, 0.5, 1.0}


def test_the_figures_are_there(folder):
    names = {"particle_migration.png", "effective_sample_size.png", "rmse.png"}
    assert names <= {path.name for path in folder.iterdir()}


def test_an_interrupted_run_leaves_the_times(tmp_path, monkeypatch):
    def interrupted(*arguments):
        raise KeyboardInterrupt

    few(monkeypatch)
    monkeypatch.setenv("MPFJAX_DATA", "/nowhere")
    times = {name: [1.0, 2.0] for name in FILTERS}
    monkeypatch.setattr(gm_mpf, "time_filters", lambda *arguments: times)
    monkeypatch.setattr(gm_mpf, "time_quadratic", lambda *arguments: times)
    monkeypatch.setattr(gm_mpf, "profile", lambda *arguments: {"a part": 1.0})
    monkeypatch.setattr(gm_mpf, "study", interrupted)
    assert gm_mpf.main(["--frames", "1:2", "--out", str(tmp_path)]) == 130
    assert json.loads((tmp_path / "gm_mpf.json").read_text())["timing"]["pf"] == 1.5


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--seeds", "0"], "--seeds: '0'"),
        (["--particles", "1"], "--particles: '1'"),
        (["--frames", "1:3", "--ids", "1", "9"], "--ids: object 9 has no box in frame 1"),
        (["--sequence", "/nowhere"], "nowhere"),
    ],
)
def test_what_cannot_be_run_is_named(arguments, named, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("MPFJAX_DATA", "/nowhere")
    try:
        status = gm_mpf.main([*arguments, "--out", str(tmp_path)])
    except SystemExit as stop:
        status = stop.code
    assert status == 2
    assert named in capsys.readouterr().err


def test_a_target_is_held_by_its_own_particles_on_it():
    """Runs of ten frames: both targets held; the second strayed from; the second starved; the
    second with as few particles as still count, and with one less.
    """
    truth = np.tile(np.array([[50.0, 50, 20, 40], [150.0, 50, 20, 40]]), (10, 1, 1))
    target = np.tile(np.arange(40) // 20, (5, 10, 1))
    target[2, :, 20:] = 0
    target[3, :, :38] = 0
    target[4, :, :39] = 0
    centres = truth[np.arange(10)[:, None], target, :2]
    centres[1, 9, 20:, 0] += 16.0
    step = Step(np.zeros((5, 10, 2, 2)), np.zeros((5, 10)), centres, target)
    np.testing.assert_array_equal(held(step, truth), [True, False, False, True, False])


@pytest.mark.parametrize("labels", [[0, 0, 1, 1], [1, 1, 0, 0]])
def test_an_estimate_is_that_of_the_component_its_target_began(labels, blocks):
    """Whichever label K-means gave to the component."""
    mixture = ParticleMixture(
        particles=BoxState(
            jax.numpy.array(blocks), jax.numpy.array([0, 0, 1, 1], jax.numpy.int32),
            jax.numpy.array(blocks),
        ),
        log_weights=jax.numpy.log(jax.numpy.array([0.1, 0.3, 0.3, 0.3])),
        component_indicators=jax.numpy.array(labels, jax.numpy.int32),
        ancestor_indices=jax.numpy.arange(4, dtype=jax.numpy.int32),
        num_components=2,
    )  # fmt: skip
    still = np.full((60, 80, 3), 90, np.uint8)
    boxes = np.array([[5.0, 5, 10, 20], [40.0, 5, 10, 20]])
    found = Collect(make_model(still, boxes))(mixture)
    np.testing.assert_allclose(found.estimates, [[17.5, 10.0], [35.0, 10.0]], rtol=1e-6)
    sizes = 1 / (0.25**2 + 0.75**2) + 2
    np.testing.assert_allclose(found.effective_sample_size, sizes, rtol=1e-6)


@pytest.fixture
def blocks():
    return [[10.0, 10, 1, 1], [20.0, 10, 1, 1], [30.0, 10, 1, 1], [40.0, 10, 1, 1]]


@pytest.mark.thorough
@pytest.mark.real_data
def test_the_mixtures_hold_both_pedestrians(data, monkeypatch):
    monkeypatch.setenv("MPFJAX_DATA", str(data))
    targets = gm_mpf.open_targets(gm_mpf.parse_arguments(["--frames", "129:165"]))
    found = study(targets, [100], 3, 0, lambda: None, ("pf", "gm_mpf"))
    assert held(found["gm_mpf"][100], targets.truth).all()
    assert not held(found["pf"][100], targets.truth).any()
