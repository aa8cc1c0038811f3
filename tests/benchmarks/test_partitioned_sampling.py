"""The command of tables 1 to 4: what it writes, its numbers, and what it says of bad input."""

import json

import jax
import numpy as np
import pytest
from scipy import stats

from benchmarks import partitioned_sampling, partitioned_tables
from mpfjax.metrics import tracking_quality
from mpfjax.vision import joint_colour
from mpfjax.vision.boxes import boxes_of_frame, read_tracks, write_tracks
from mpfjax.vision.colours import HSVColours
from mpfjax.vision.distracter import DistracterScene, distracter_scene
from mpfjax.vision.frames import parse_range, read_frames, write_image

NUM_RUNS = 2
FIELDS = ["lambda", "method", "order", "success", "recovery", "precision", "recall", "runs"]


def run(*arguments):
    return partitioned_sampling.main([str(argument) for argument in arguments])


def content_in(folder):
    return json.loads((folder / "partitioned_sampling.json").read_text())


@pytest.fixture(scope="module", autouse=True)
def few_colours():
    """Ten bins, and three of the seven objects for eleven frames, which compile and run fast."""

    def short_scene(key):
        scene = distracter_scene(key, 11)
        return DistracterScene(scene.frames, scene.boxes[:, :3], scene.distracter)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(joint_colour, "HSVColours", lambda: HSVColours(4, 2, 2))
        patch.setattr(partitioned_sampling, "distracter_scene", short_scene)
        yield


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    out = tmp_path_factory.mktemp("synthetic")
    assert run("--runs", NUM_RUNS, "--particles", 24, "--lambdas", 20, 50, "--out", out,
               "--methods", "ps", "dps") == 0  # fmt: skip
    return out


def test_the_file_has_the_form_of_the_issue(finished):
    content = content_in(finished)
    assert set(content) >= {"tables", "uniqueness", "effective_dynamics"}
    assert set(content["tables"]) == {"1", "2"}
    for rows in content["tables"].values():
        assert [(row["lambda"], row["method"], row["order"]) for row in rows] == [
            (lambda_, method, order)
            for lambda_ in (20, 50)
            for method, order in (
                ("ps", [1, 2, 3]),
                ("ps", [2, 3, 1]),
                ("ps", [3, 1, 2]),
                ("dps", None),
            )
        ]
        for row in rows:
            assert list(row)[: len(FIELDS)] == FIELDS
            assert row["runs"] == NUM_RUNS
            for rate in FIELDS[3:7]:
                low, high = row[f"{rate}_interval"]
                assert 0 <= low <= row[rate] <= high <= 1
    labels = {"ps 1,2,3", "ps 2,3,1", "ps 3,1,2", "dps"}
    assert set(content["uniqueness"]) == set(content["effective_dynamics"]) == labels
    assert all(len(shares) == 3 for shares in content["uniqueness"].values())
    for dynamics in content["effective_dynamics"].values():
        assert set(dynamics) == {"u", "v"}
        assert all(len(values) == 3 for values in dynamics.values())


def test_uniqueness_is_that_of_the_filters(finished):
    """All hypotheses of the last stage differ, after which nothing is resampled."""
    uniqueness = content_in(finished)["uniqueness"]
    for order in ("1,2,3", "2,3,1", "3,1,2"):
        shares = uniqueness[f"ps {order}"]
        stages = [shares[int(j) - 1] for j in order.split(",")]
        assert stages[0] < stages[1] < stages[2] == pytest.approx(1)
    assert min(uniqueness["dps"]) > max(uniqueness["dps"]) / 2


def test_summaries_are_those_of_the_orders(finished):
    content = content_in(finished)
    for table in ("1", "2"):
        own = [row for row in content["tables"][table] if row["method"] == "ps"]
        for lambda_ in (20, 50):
            rates = [row["recovery"] for row in own if row["lambda"] == lambda_]
            mean, worst = (row for row in content["summary"][table] if row["lambda"] == lambda_)
            assert mean["order"] == "mean"
            assert mean["recovery"] == pytest.approx(np.mean(rates))
            assert mean["runs"] == 3 * NUM_RUNS
            assert worst["order"] == "worst"
            assert worst["recovery"] == pytest.approx(min(rates))


def test_pictures_are_written(finished):
    names = {path.name for path in finished.iterdir()}
    assert names >= {"uniqueness.png", "recovery.png", "contact_sheet.png", "recovery.gif"}
    assert not any(name.endswith(".partial") for name in names)
    pictures = list(read_frames(finished / "recovery.gif"))
    assert len(pictures) == 11
    assert pictures[0].shape == (288, 2 * 360 + 4, 3)


@pytest.fixture(scope="module")
def sequence(tmp_path_factory):
    """Six frames as a folder with img/ and gt.txt; object 2 has left before the last."""
    folder = tmp_path_factory.mktemp("sequence")
    scene = distracter_scene(jax.random.key(1), 6)
    (folder / "img").mkdir()
    rows = []
    for t, frame in enumerate(scene.frames, 1):
        write_image(folder / "img" / f"{t:06d}.png", frame)
        rows += [[t, j + 1, *scene.boxes[t - 1, j]] for j in range(3) if not (j == 1 and t == 6)]
    write_tracks(folder / "gt.txt", np.array(rows))
    return folder


def test_a_sequence_makes_table_3_for_the_first_id(sequence, tmp_path, capsys):
    assert run("--sequence", sequence, "--ids", 2, 1, "--frames", "2:6", "--runs", NUM_RUNS,
               "--particles", 24, "--methods", "joint", "--out", tmp_path) == 0  # fmt: skip
    content = content_in(tmp_path)
    assert list(content["tables"]) == ["3"]
    assert [row["method"] for row in content["tables"]["3"]] == ["joint"]
    assert content["uniqueness"]["joint"] == pytest.approx([1, 1])
    assert content["settings"]["frames"] == [2, 6]
    printed = capsys.readouterr().out
    assert "table 3" in printed
    assert "RealSeq1" in printed


def test_an_interrupted_run_leaves_what_it_finished(tmp_path, monkeypatch):
    def interrupted(scene, lambdas, *rest):
        kept = partitioned_sampling.Kept(
            np.broadcast_to(scene.truth[None], (NUM_RUNS, *scene.truth.shape)),
            np.ones((NUM_RUNS, 11, 3)),
            np.ones((NUM_RUNS, 11, 3, 2)),
            np.ones((2, 11, 5, 3, 2)),
        )
        yield partitioned_sampling.Row(lambdas[0], "joint", None, kept, {True: 0, False: None})
        raise KeyboardInterrupt

    monkeypatch.setattr(partitioned_sampling, "study", interrupted)
    assert run("--runs", NUM_RUNS, "--particles", 24, "--lambdas", 20, "--out", tmp_path) == 130
    (row,) = content_in(tmp_path)["tables"]["2"]
    assert [row[field] for field in FIELDS] == [20, "joint", None, 1, 1, 1, 1, NUM_RUNS]


@pytest.mark.parametrize(
    ("message", "arguments"),
    [
        ("no box of [9] in frame 1", ["--ids", "1", "9"]),
        ("frame 40 is not among them", ["--frames", "40:50", "--ids", "1"]),
        ("--frames: '5' is not A:B", ["--frames", "5"]),
        ("is not a folder", ["--sequence", "nowhere"]),
        ("num_particles", ["--particles", "2"]),
    ],
)
def test_bad_input_is_named_before_anything_compiles(
    sequence, tmp_path, capsys, monkeypatch, message, arguments
):
    monkeypatch.setattr(partitioned_sampling, "study", lambda *_: pytest.fail("it went on"))
    start = [] if "--sequence" in arguments else ["--sequence", sequence]
    assert run(*start, "--out", tmp_path / "out", *arguments) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("message", "arguments"),
    [
        ("--runs: '0' is not a whole number from 1", ["--runs", "0"]),
        ("--particles: '0' is not a whole number from 1", ["--particles", "0"]),
        ("--lambdas: '-1' is not a positive", ["--lambdas", "20", "-1"]),
        ("--ids, --frames: without --sequence", ["--ids", "1"]),
        ("invalid choice: 'best'", ["--methods", "best"]),
    ],
)
def test_wrong_options_are_named(capsys, message, arguments):
    with pytest.raises(SystemExit, match="2"):
        run(*arguments)
    assert message in capsys.readouterr().err


class TestRates:
    """What a row says, against the library's measures and against scipy."""

    ESTIMATES = np.random.default_rng(0).normal(0, 4, (9, 6, 2, 4)) + np.array([5, 5, 20, 20])
    TRUTH = np.broadcast_to(np.array([10.0, 10, 8, 8]), (6, 2, 4)).copy()

    def test_are_the_measures_of_section_3_1(self):
        truth = self.TRUTH.copy()
        truth[4, 1] = np.nan
        estimates = self.ESTIMATES.astype(np.float32)
        estimates[:3, 2:4, 0] += 100
        estimates[5:, -1, 1] -= 100
        for j in (0, 1):
            row = partitioned_tables.measure(estimates[:, :, [j]], truth[:, [j]]).as_dict()
            expected = tracking_quality(
                jax.numpy.asarray(estimates[:, :, [j]]),
                jax.numpy.asarray(truth[:, [j]].astype(np.float32)),
                num_last=partitioned_tables.NUM_LAST,
            )
            assert row["success"] == pytest.approx(float(expected.success_rate[0]))
            assert row["recovery"] == pytest.approx(float(expected.recovery_rate[0]))
            assert row["precision"] == pytest.approx(float(expected.precision[0]), rel=1e-5)
            assert row["recall"] == pytest.approx(float(expected.recall[0]), rel=1e-5)

    @pytest.mark.parametrize(("successes", "trials"), [(0, 50), (19, 50), (50, 50), (1, 2)])
    def test_wilson_is_scipys(self, successes, trials):

        expected = stats.binomtest(successes, trials).proportion_ci(method="wilson")
        actual = partitioned_tables.wilson(successes / trials, trials)
        np.testing.assert_allclose(actual, [expected.low, expected.high], atol=1e-9)

    def test_a_ratio_covers_its_expectation(self):
        """Sums of 0.7 of their counts and noise: 95% of the intervals hold 0.7."""
        rng = np.random.default_rng(1)
        hits = []
        for _ in range(400):
            counts = rng.integers(1, 20, 50)
            sums = 0.7 * counts + 0.2 * np.sqrt(counts) * rng.standard_normal(50)
            _, (low, high) = partitioned_tables.ratio(sums, counts)
            hits.append(low <= 0.7 <= high)
        assert abs(np.mean(hits) - 0.95) < 4 * np.sqrt(0.95 * 0.05 / 400)

    def test_never_tracked(self):
        assert partitioned_tables.ratio(np.zeros(3), np.zeros(3)) == (0.0, [0.0, 1.0])


def test_the_papers_figures_stand_where_they_belong():
    place = partitioned_tables.paper_of
    row = {"lambda": 30.0, "method": "ps", "order": "worst"}
    assert place("2", 0, row) == "  8  16  16"
    assert place("1", 0, row | {"order": "mean"}) == "100  91  87"
    assert place("1", 0, row) == "-"
    assert place("2", 0, row | {"order": [1, 2]}) == "-"
    assert place("2", 0, row | {"method": "independent", "order": None}) == "-"
    last = row | {"order": [1, 2, 3, 4]}
    assert place("4", 3, last) == " 26  28  46  77"
    assert place("3", 1, row | {"order": [1, 2]}) == " 40  96  58  98 |  12  40  72  86"
    assert place("3", 0, row | {"method": "dps", "order": None}).startswith("100 100  62 100 |")


def test_claims_tell_what_does_not_hold():
    """DPS below the mean of the orders is no support of table 2, and of table 4 it is."""

    def row(method, recovery, order=None):
        interval = [recovery - 0.05, recovery + 0.05]
        return {"lambda": 20.0, "method": method, "order": order, "recovery": recovery,
                "recovery_interval": interval}  # fmt: skip

    def holds(table, dps):
        content = {
            "tables": {table: [row("joint", 0.1), row("dps", dps)]},
            "summary": {table: [row("ps", 0.5, "mean"), row("ps", 0.2, "worst")]},
            "uniqueness": {"ps 2,1": [1.0, 0.2], "dps": [0.5, 0.2]},
        }
        return [(c["claim"], c["holds"], c["clear"]) for c in partitioned_tables.checks_of(content)]

    found = holds("2", 0.52)
    assert ("dps has a higher recovery than PS mean", True, False) in found
    assert ("dps has a higher recovery than PS worst", True, True) in found
    assert ("dps has a higher recovery than PS mean", False, False) in holds("2", 0.4)
    assert ("PS mean has a higher recovery than dps", True, True) in holds("4", 0.3)
    assert ("uniqueness falls towards the first stage under ps 2,1", True, True) in found
    claim = "no object has less than half of another's uniqueness under dps"
    assert (claim, False, False) in found


@pytest.mark.real_data
def test_the_stretches_are_those_of_the_data(data):
    """Every object is there in the first frame, and the occluded one in the last."""
    for name, stretches in partitioned_sampling.STRETCHES.items():
        if not (data / name).is_dir():
            pytest.skip(f"no sequence at {data / name}")
        rows = read_tracks(data / name / "gt.txt")
        for stretch in stretches:
            first, last = parse_range(stretch.frames)
            assert set(stretch.ids) <= set(boxes_of_frame(rows, first))
            assert last is not None
            assert stretch.occluded in stretch.ids
            assert stretch.occluded in boxes_of_frame(rows, last)
