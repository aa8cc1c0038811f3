"""The command of tables 1 to 4: scenes, maps, events, what it writes, and bad input."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import mpfjax
from benchmarks.partitioned_sampling import __main__ as partitioned_sampling
from benchmarks.partitioned_sampling import (
    claims,
    command,
    events,
    maps,
    paper,
    posterior,
    rates,
    scenes,
    sensitivity,
    study,
    tables,
)
from benchmarks.scenes import distracter_scene
from mpfjax.metrics import tracking_quality
from mpfjax.vision import (
    BoxState,
    HSVColours,
    joint_colour_model,
    write_tracks,
)
from mpfjax.vision.files.frames import read_frames, write_image

NUM_RUNS = 2
FIELDS = ["scene", "lambda", "method", "order", "success", "recovery", "precision", "recall",
          "runs"]  # fmt: skip
KEPT = posterior.Verdict(6, 11, 25)


def run(*arguments):
    return partitioned_sampling.main([str(argument) for argument in arguments])


def content_in(folder):
    return json.loads((folder / "partitioned_sampling.json").read_text())


def few_objects(key, setting=scenes.DEFAULT, *, only_if_kept=False):
    """Three of the seven objects for eleven frames, which compile and run fast; odd keys only."""
    if only_if_kept and key % 2 == 0:
        return None
    drawn = distracter_scene(jax.random.key(key), 11, size=setting.size, speed=setting.speed)
    starts = drawn.boxes[0, :3, :2] + np.array(setting.size) / 2
    bins = np.asarray(scenes._bins(jnp.asarray(drawn.frames)))
    references = np.eye(110)[bins[0, :6].reshape(3, 2, -1)].mean(axis=2)
    whole = maps.Window.whole(bins[0], setting.size)
    return scenes.Scene(
        key, f"key {key}", drawn.frames, 1, drawn.boxes[:, :3], 0,
        jnp.asarray([maps.distance_maps(frame, references, setting.size, whole) for frame in bins]),
        lambda lambda_: maps.mapped_model(starts, setting.size, lambda_, 0.5, (2.0, 2.0)),
        lambda everything: scenes._place_collector(setting.size, everything),
        np.array([2.0, 2.0]), KEPT,
    )  # fmt: skip


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    out = tmp_path_factory.mktemp("synthetic")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scenes, "synthetic_scene", few_objects)
        assert run("--scenes", 2, "--runs", NUM_RUNS, "--particles", 24, "--lambdas", 20, 50,
                   "--out", out, "--methods", "ps", "dps") == 0  # fmt: skip
    return out


def test_the_file_has_a_row_for_each_scene(finished):
    content = content_in(finished)
    assert set(content["tables"]) == {"1", "2"}
    assert content["settings"]["passed_over"] == [0, 2]
    assert [entry["scene"] for entry in content["scenes"]] == [1, 3]
    filters = [("ps", [1, 2, 3]), ("ps", [2, 3, 1]), ("ps", [3, 1, 2]), ("dps", None)]
    for rows in content["tables"].values():
        assert [(row["scene"], row["lambda"], row["method"], row["order"]) for row in rows] == [
            (scene, lambda_, *which) for scene in (1, 3) for lambda_ in (20, 50)
            for which in filters
        ]  # fmt: skip
        for row in rows:
            assert list(row)[: len(FIELDS)] == FIELDS
            assert row["runs"] == NUM_RUNS
            for rate in FIELDS[4:8]:
                low, high = row[f"{rate}_interval"]
                assert 0 <= low <= row[rate] <= high <= 1
    labels = {"ps 1,2,3", "ps 2,3,1", "ps 3,1,2", "dps"}
    assert set(content["uniqueness"]) == set(content["effective_dynamics"]) == labels
    assert all(len(shares) == 3 for shares in content["uniqueness"].values())


def test_uniqueness_is_that_of_the_filters(finished):
    """All hypotheses of the last stage differ, after which nothing is resampled."""
    uniqueness = content_in(finished)["uniqueness"]
    for order in ("1,2,3", "2,3,1", "3,1,2"):
        shares = uniqueness[f"ps {order}"]
        stages = [shares[int(j) - 1] for j in order.split(",")]
        assert stages[0] < stages[1] < stages[2] == pytest.approx(1)
    assert min(uniqueness["dps"]) > max(uniqueness["dps"]) / 2


def test_summaries_are_those_of_the_orders_and_means_those_of_the_scenes(finished):
    content = content_in(finished)
    for table in ("1", "2"):
        for lambda_ in (20, 50):
            of_scenes = []
            for scene in (1, 3):
                own = [
                    row
                    for row in content["tables"][table]
                    if (row["scene"], row["lambda"], row["method"]) == (scene, lambda_, "ps")
                ]
                shares = [row["recovery"] for row in own]
                entries = {entry["order"]: entry for entry in content["summary"][table]
                           if (entry["scene"], entry["lambda"]) == (scene, lambda_)}  # fmt: skip
                assert entries["mean"]["recovery"] == pytest.approx(np.mean(shares))
                assert entries["mean"]["runs"] == 3 * NUM_RUNS
                assert entries["worst"]["recovery"] == pytest.approx(min(shares))
                assert entries["first"]["recovery"] == pytest.approx(shares[0])
                assert entries["last"]["recovery"] == pytest.approx(shares[1])
                of_scenes.append(entries["mean"]["precision"])
            (mean,) = [e for e in content["means"][table]
                       if (e["lambda"], e["order"]) == (lambda_, "mean")]  # fmt: skip
            assert mean["precision"] == pytest.approx(np.mean(of_scenes))
            assert mean["precision_sd"] == pytest.approx(np.std(of_scenes, ddof=1))
            assert mean["scenes"] == 2


def test_another_cycle_is_a_different_order(finished):
    cycles = content_in(finished)["other_cycles"]
    assert list(cycles["recovery"]) == ["1,3,2"]
    assert cycles["best"]["order"] == cycles["worst"]["order"] == [1, 3, 2]
    sample = study.other_cycles(7)
    assert len(set(sample)) == 20
    natural = study.circular_orders(7)
    assert all(sorted(order) == list(range(7)) and order[0] == 0 for order in sample)
    assert not set(sample) & set(natural)
    assert study.other_cycles(2) == []


def test_pictures_are_written(finished):
    names = {path.name for path in finished.iterdir()}
    assert names >= {"uniqueness.png", "recovery.png", "contact_sheet.png", "recovery.gif"}
    pictures = list(read_frames(finished / "recovery.gif"))
    assert len(pictures) == 11
    assert pictures[0].shape == (288, 2 * 360 + 4, 3)


@pytest.mark.thorough
def test_sensitivity_has_every_filter_in_every_case(tmp_path, monkeypatch):
    monkeypatch.setattr(scenes, "synthetic_scene", few_objects)
    monkeypatch.setattr(sensitivity, "FILTERS", {"ps": "PS", "dps": "DPS"})
    cases = [case for case in sensitivity.CASES if case.axis == sensitivity.SPEED][:2]
    monkeypatch.setattr(sensitivity, "CASES", cases)
    assert run("--sensitivity", "--scenes", 1, "--runs", NUM_RUNS, "--particles", 24, "--out",
               tmp_path) == 0  # fmt: skip
    entries = json.loads((tmp_path / "sensitivity.json").read_text())["entries"]
    assert [(entry["value"], entry["filter"]) for entry in entries] == [
        (speed, name) for speed in (0, 2) for name in ("PS", "DPS")
    ]
    assert all(entry["keys_tried"] == 2 and entry["scenes"] == 1 for entry in entries)
    assert (tmp_path / "sensitivity.png").is_file()


def test_sensitivity_has_the_tables_scene_on_every_axis_and_the_old_one():
    for axis, value in sensitivity.CHOSEN.items():
        (case,) = [c for c in sensitivity.CASES if (c.axis, c.value) == (axis, value)]
        assert case.setting == scenes.DEFAULT
    assert [case.setting.speed for case in sensitivity.CASES if case.axis == sensitivity.OLD] == [6]


@pytest.mark.thorough
class TestMaps:
    """The likelihood read off a map is the colour model's."""

    def test_is_that_of_the_colour_model(self):
        drawn = distracter_scene(jax.random.key(0), 4)
        model = joint_colour_model(drawn.frames[0], drawn.boxes[0], lambda_=30.0)
        references = np.asarray(model.object_model.references)[:, 0, :, 0]
        bins = np.asarray(HSVColours().bins(jnp.asarray(drawn.frames[3])))[:, :, 0]
        sides = (24, 24)
        whole = maps.Window.whole(bins, sides)
        found = maps.distance_maps(bins, references[[4]], sides, whole)[0]
        mapped = maps.mapped_model(np.zeros((1, 2)), sides, 30.0, 0.5, (2.0, 2.0)).object_at(0)
        rng = np.random.default_rng(0)
        near = drawn.boxes[3, 4, :2] + 12 + 15 * rng.standard_normal((100, 2))
        places = np.concatenate([rng.uniform([-40, -40], [400, 330], (100, 2)), near])
        places = jnp.asarray(places, jnp.float32)
        states = BoxState(jnp.concatenate([places, jnp.ones((200, 2))], 1), jnp.zeros(200, int))
        expected = model.object_at(4).log_likelihood(jnp.asarray(drawn.frames[3]), states)
        actual = mapped.log_likelihood(jnp.asarray(found), maps.PlaceState(places, places))
        assert np.ptp(expected) > 20
        np.testing.assert_allclose(actual, expected, atol=1e-4)
        part = maps.distance_maps(bins, references[[4]], sides, maps.Window(-30, 40, 300, 380))
        outside = np.full((6, 70), 2.0)
        np.testing.assert_allclose(part[0, 6:, :61], found[:64, 324:], atol=1e-5)
        np.testing.assert_allclose(part[0, :6, :70], outside, atol=1e-5)

    def test_bands_that_end_within_pixels_are_named(self):
        with pytest.raises(ValueError, match="sides: 2 bands of a height of 25"):
            maps.distance_maps(np.zeros((9, 9), int), np.ones((1, 2, 3)), (24, 25),
                               maps.Window(0, 1, 0, 1))  # fmt: skip


class TestPosterior:
    """The lattice filter against many particles, and what a verdict is."""

    def test_is_the_mean_of_many_particles(self):
        """An object on a plain ground; 50 000 particles err by some hundredths of a pixel."""
        rng = np.random.default_rng(3)
        corners = np.cumsum(np.concatenate([[[30, 26]], rng.integers(-4, 5, (5, 2))]), axis=0)
        bins = np.zeros((6, 80, 90), int)
        for frame, (x, y) in zip(bins, corners, strict=True):
            frame[y : y + 8, x : x + 10] = 1
        reference = np.tile([0.0, 1.0], (2, 1))
        start, sides = corners[0] + np.array([5, 4]), (10, 8)
        means = posterior.posterior_means(bins, reference, start, sides, lambda_=3.0)
        whole = maps.Window.whole(bins[0], sides)
        found = np.stack([maps.distance_maps(f, reference[None], sides, whole) for f in bins])
        model = maps.mapped_model(start[None], sides, 3.0, 0.5, (2.0, 2.0))

        def place(mixture):
            return mixture.average(mixture.particles.place)

        filter = mpfjax.particle_filter(model, 50_000)
        many = mpfjax.run_filter(jax.random.key(0), filter, jnp.asarray(found), place)
        np.testing.assert_allclose(means, np.asarray(many.collected)[:, 0], atol=0.1)
        assert np.abs(means - corners - np.array([5, 4])).max() > 0.3

    @pytest.mark.parametrize(
        ("lost", "left", "back", "keeps"),
        [
            ([], None, None, False),
            ([5, 6, 7, 8, 9], 6, 11, True),
            ([5, 6, 7, 8], 6, 10, False),
            ([5, 21], 6, 23, True),
            ([5, 22], 6, 24, False),
            ([5, 24], 6, None, False),
        ],
    )
    def test_verdict(self, lost, left, back, keeps):
        truth = np.broadcast_to([10.0, 20.0, 24.0, 24.0], (25, 4))
        means = np.tile([22.0 + 23.9, 32.0], (25, 1))
        means[lost, 0] += 0.2
        verdict = posterior.judge(means, truth)
        assert (verdict.left, verdict.back, verdict.keeps) == (left, back, keeps)


class TestEvents:
    """Where somebody is hidden, from boxes that were made for it."""

    def rows(self, hidden=(20, 27), way=24.0, until=60):
        """Object 1 walks behind object 2, which stands; object 3 is far away."""
        rows = []
        for t in range(1, until + 1):
            share = np.clip((t - hidden[0] + 1) / (hidden[1] - hidden[0] + 2), 0, 1)
            is_hidden = hidden[0] <= t <= hidden[1]
            x = 100 + way * share
            rows.append([t, 1, x, 50, 20, 60])
            rows.append([t, 2, x - 4 if is_hidden else 140, 52, 28, 70])
            rows.append([t, 3, 10, 50, 20, 60])
        return np.array(rows, float)

    def found(self, rows, tmp_path):
        write_tracks(tmp_path / "gt.txt", rows)
        return events.find_events(tmp_path)

    def test_finds_who_is_hidden_and_comes_out_elsewhere(self, tmp_path):
        (event,) = self.found(self.rows(), tmp_path)
        assert event == events.Event((1, 2, 3), (10, 37), (20, 27))

    @pytest.mark.parametrize(
        "changes", [{"hidden": (20, 24)}, {"way": 5.0}, {"until": 27}], ids=lambda c: next(iter(c))
    )
    def test_passes_over_what_is_too_short_or_stays_or_does_not_come_out(self, changes, tmp_path):
        with pytest.raises(ValueError, match=r"--sequence: in .* no object is covered for 6"):
            self.found(self.rows(**changes), tmp_path)

    def test_who_stands_behind_hides_nobody(self, tmp_path):
        rows = self.rows()
        rows[rows[:, 1] == 2, 3] = 30
        with pytest.raises(ValueError, match="no object is covered"):
            self.found(rows, tmp_path)


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


@pytest.mark.thorough
def test_a_sequence_makes_table_3_for_the_first_id(sequence, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("mpfjax.vision.boxes.joint_colour.HSVColours", lambda: HSVColours(4, 2, 2))
    assert run("--sequence", sequence, "--ids", 2, 1, "--frames", "2:6", "--runs", NUM_RUNS,
               "--particles", 24, "--methods", "joint", "--out", tmp_path) == 0  # fmt: skip
    content = content_in(tmp_path)
    assert list(content["tables"]) == ["3"]
    assert [row["method"] for row in content["tables"]["3"]] == ["joint"]
    assert content["uniqueness"]["joint"] == pytest.approx([1, 1])
    printed = capsys.readouterr().out
    assert "tables 3 and 4" in printed
    assert "RealSeq1" in printed


def test_an_interrupted_run_leaves_the_scenes_it_finished(tmp_path, monkeypatch):
    def interrupted(scene, number, lambdas, *rest, **options):
        if number > 1:
            raise KeyboardInterrupt
        boxes = np.broadcast_to(scene.truth[None], (NUM_RUNS, *scene.truth.shape))
        yield study.Row(scene.key, lambdas[0], "joint", None, scenes.Kept(boxes), {})

    monkeypatch.setattr(scenes, "synthetic_scene", few_objects)
    monkeypatch.setattr(command, "study", interrupted)
    assert run("--runs", NUM_RUNS, "--particles", 24, "--lambdas", 20, "--out", tmp_path) == 130
    (row,) = content_in(tmp_path)["tables"]["2"]
    assert [row[field] for field in FIELDS] == [1, 20, "joint", None, 1, 1, 1, 1, NUM_RUNS]


@pytest.mark.parametrize(
    ("message", "arguments"),
    [
        ("no box of [9] in frame 1", ["--ids", "1", "9"]),
        ("frame 40 is not among them", ["--frames", "40:50", "--ids", "1"]),
        ("--frames: '5' is not A:B", ["--frames", "5"]),
        ("is not a folder", ["--sequence", "nowhere"]),
        ("no object is covered for 6 frames", []),
        ("num_particles", ["--particles", "2", "--ids", "1", "2", "3"]),
    ],
)
def test_bad_input_is_named_before_anything_compiles(
    sequence, tmp_path, capsys, monkeypatch, message, arguments
):
    monkeypatch.setattr(command, "study", lambda *_, **__: pytest.fail("it went on"))
    start = [] if "--sequence" in arguments else ["--sequence", sequence]
    assert run(*start, "--out", tmp_path / "out", *arguments) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_scenes_beyond_the_keys_are_named(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(scenes, "synthetic_scene", lambda *_, **__: None)
    assert run("--scenes", 3, "--out", tmp_path / "out") == 2
    assert "--scenes: 3, but of the 100 keys from 0 on the posterior keeps 0" in (
        capsys.readouterr().err
    )
    assert run("--keys", "4:6", "--out", tmp_path / "out") == 2
    assert "--keys: the posterior keeps the scene of none" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("message", "arguments"),
    [
        ("--runs: '0' is not a whole number from 1", ["--runs", "0"]),
        ("--scenes: '0' is not a whole number from 1", ["--scenes", "0"]),
        ("--keys: '7:3' is not A:B", ["--keys", "7:3"]),
        ("--keys: '7' is not A:B", ["--keys", "7"]),
        ("--lambdas: '-1' is not a positive", ["--lambdas", "20", "-1"]),
        ("--ids, --frames: without --sequence", ["--ids", "1"]),
        ("--ids, --frames: of one --sequence", ["--ids", "1", "--sequence", "a", "b"]),
        ("--event: does nothing", ["--event", "1"]),
        ("--event: does nothing", ["--sequence", "a", "--ids", "1", "--event", "1"]),
        ("--scene: does nothing with --sequence", ["--sequence", "a", "--scene", "1"]),
        ("--scenes: does nothing with --sequence", ["--scene", "1", "--scenes", "2"]),
        ("--scene: not with --keys", ["--scene", "1", "--keys", "1:2"]),
        ("--sensitivity: not with --sequence", ["--sensitivity", "--sequence", "a"]),
        ("--lambdas: does nothing with --sensitivity", ["--sensitivity", "--lambdas", "20"]),
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
            row = rates.measure(estimates[:, :, [j]], truth[:, [j]]).as_dict()
            expected = tracking_quality(
                jnp.asarray(estimates[:, :, [j]]),
                jnp.asarray(truth[:, [j]].astype(np.float32)),
                num_last=rates.NUM_LAST,
            )
            assert row["success"] == pytest.approx(float(expected.success_rate[0]))
            assert row["recovery"] == pytest.approx(float(expected.recovery_rate[0]))
            assert row["precision"] == pytest.approx(float(expected.precision[0]), rel=1e-5)
            assert row["recall"] == pytest.approx(float(expected.recall[0]), rel=1e-5)

    @pytest.mark.parametrize(("successes", "trials"), [(0, 50), (19, 50), (50, 50), (1, 2)])
    def test_wilson_is_scipys(self, successes, trials):
        expected = stats.binomtest(successes, trials).proportion_ci(method="wilson")
        actual = rates.wilson(successes / trials, trials)
        np.testing.assert_allclose(actual, [expected.low, expected.high], atol=1e-9)

    def test_a_ratio_covers_its_expectation(self):
        """Sums of 0.7 of their counts and noise: 95% of the intervals hold 0.7."""
        rng = np.random.default_rng(1)
        hits = []
        for _ in range(400):
            counts = rng.integers(1, 20, 50)
            sums = 0.7 * counts + 0.2 * np.sqrt(counts) * rng.standard_normal(50)
            _, (low, high) = rates.ratio(sums, counts)
            hits.append(low <= 0.7 <= high)
        assert abs(np.mean(hits) - 0.95) < 4 * np.sqrt(0.95 * 0.05 / 400)

    def test_never_tracked(self):
        assert rates.ratio(np.zeros(3), np.zeros(3)) == (0.0, [0.0, 1.0])

    def test_least_and_greatest_are_those_of_simulated_draws(self):
        """Of 20 draws over two scenes; 4000 repeats have a standard error of 0.05 of a run."""
        rng = np.random.default_rng(0)
        draws = rng.binomial(50, 0.1, (4000, 20)) + rng.binomial(50, 0.4, (4000, 20))
        expected = [draws.min(axis=1).mean() / 100, draws.max(axis=1).mean() / 100]
        actual = rates.least_and_greatest([0.1, 0.4], 50, 20)
        np.testing.assert_allclose(actual, expected, atol=0.003)

    def test_orders_that_differ_are_told_from_those_that_do_not(self):
        """Under one binomial p is uniform; where half of the orders recover more, it is small."""
        rng = np.random.default_rng(2)
        share = np.array([[0.2], [0.5]])
        same = [tables.alike(rng.binomial(50, share, (2, 7)) / 50, 50) for _ in range(400)]
        assert stats.kstest(same, "uniform").pvalue > 0.001
        raised = share + 0.2 * (np.arange(7) % 2)
        other = [tables.alike(rng.binomial(50, raised, (2, 7)) / 50, 50) for _ in range(100)]
        assert np.mean(np.array(other) < 0.05) > 0.8
        assert tables.alike(np.zeros((2, 7)), 50) == 1


def test_the_papers_figures_stand_where_they_belong():
    row = {"lambda": 30.0, "method": "ps", "order": "worst"}
    assert paper.paper_of("2", row) == "  8  16  16"
    assert paper.paper_of("1", row | {"order": "mean"}) == "100  91  87"
    assert paper.paper_of("1", row) == "-"
    assert paper.paper_of("2", row | {"method": "independent", "order": None}) == "-"
    last = " 40  96  58  98 |  12  40  72  86 |  26  28  46  77"
    assert paper.paper_of("3", row | {"order": "last"}) == last
    dps = paper.paper_of("3", row | {"method": "dps", "order": None})
    assert dps.startswith("100 100  62 100 |")


def test_claims_tell_what_does_not_hold():
    def entry(method, recovery, order=None, scene=None):
        head = {"lambda": 20.0, "method": method, "order": order, "recovery": recovery}
        return head | ({} if scene is None else {"scene": scene})

    def holds(joint, dps):
        content = {
            "means": {"2": [entry("joint", joint), entry("dps", np.mean(dps)),
                            entry("ps", 0.2, "mean")]},
            "tables": {"2": [entry("dps", share, None, k) for k, share in enumerate(dps)]},
            "summary": {"2": [entry("ps", 0.2, "mean", k) for k in range(len(dps))]},
            "uniqueness": {"ps 2,1": [1.0, 0.05], "dps": [0.5, 0.2]},
        }  # fmt: skip
        return {check["claim"]: check["holds"] for check in claims.checks_of(content)}

    found = holds(0.1, [0.5, 0.4, 0.4, 0.1])
    assert found["joint has a recovery of 15% or less"]
    assert found["recovery rises from joint over PS to DPS"]
    assert found["dps recovers by 10 points or more above PS in the mean over λ"]
    assert found["dps recovers above PS in three quarters of the scenes or more"]
    assert found["uniqueness falls towards the first stage under ps 2,1"]
    assert not found["no object has less than half of another's uniqueness under dps"]
    found = holds(0.3, [0.25, 0.25, 0.1, 0.1])
    assert not any(
        found[claim] for claim in found if "joint" in claim or claim.startswith("dps recovers")
    )


@pytest.mark.real_data
def test_the_events_are_those_of_the_data(data):
    """Every one can be run: all its objects are there at the start, the hidden one at the end."""
    found = 0
    for folder in sorted(path for path in data.iterdir() if (path / "gt.txt").is_file()):
        try:
            of_folder = events.find_events(folder)
        except ValueError:
            continue
        ids, boxes = events.tracks(events.read_truth(folder / "gt.txt").objects)
        for event in of_folder:
            found += 1
            own = [ids.index(id) for id in event.ids]
            first, last = event.frames
            assert np.isfinite(boxes[first, own]).all()
            assert np.isfinite(boxes[last, own[0]]).all()
            assert first < event.hidden[0] <= event.hidden[1] - 5 < last
    assert found


def test_a_key_without_a_path_is_passed_over():
    """Among so many keys there is one: it ended the whole sensitivity study."""
    assert list(scenes.synthetic_scenes([16], setting=sensitivity.CASES[-1].setting)) == [
        (16, None)
    ]
