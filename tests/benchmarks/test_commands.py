"""Every command runs with --quick and writes its files; the harness does what it says."""

import importlib
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import pytest
from scipy import stats

from benchmarks import harness
from benchmarks.peers.__main__ import disagreement

# The files that each writes; options beside --quick follow the name.
OF_VIDEO = "visual_tracking.json contact_sheet.png tracking.mp4 tracks_pf.txt tracks_mpf.txt"
COMMANDS = {
    "first_result": "first_result.json",
    "gm_mpf": "gm_mpf.json particle_migration.png",
    "hand_written_c": "hand_written_c.json",
    "interacting_objects": "interacting_objects.json interacting_objects.png",
    "likelihood_tuning": (
        "gradients.json shifts.json learned.json coverage.json many_dimensions.json"
    ),
    "localisation": "localisation.json recovery.png",
    "marginalised": "marginalised.json",
    "masses": "masses.json masses.png",
    "multi_target": "multi_target.json multi_target.png",
    "partitioned_sampling": "partitioned_sampling.json uniqueness.png",
    "peers": "peers.json peers.png",
    "scaling": "scaling.json",
    "score_vs_particles": "score_vs_particles.json score_vs_particles.png typical_run.png",
    "smoothing": "smoothing.json posteriors.png",
    "tracking_by_detection": "tracking_by_detection.json",
    "tracking_speed": "tracking_speed.json",
    "visual_tracking": OF_VIDEO,
    "visual_tracking --preset objects": OF_VIDEO,
    "visual_tracking --detect --frames 1:12": f"{OF_VIDEO} tracks_gm_mpf.txt",
}


def main_of(name):
    """The function that `python -m benchmarks.NAME` calls."""
    module = importlib.import_module(f"benchmarks.{name}")
    if not hasattr(module, "main"):
        module = importlib.import_module(f"benchmarks.{name}.__main__")
    return module.main


@pytest.mark.weekly
@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_runs_and_writes_its_files(command, tmp_path, capsys):
    name, *options = command.split()
    assert main_of(name)(["--quick", *options, "--out", str(tmp_path)]) == 0
    assert capsys.readouterr().out
    for file in COMMANDS[command].split():
        assert (tmp_path / file).stat().st_size > 50, file


# --- the harness --------------------------------------------------------------------------------


@harness.command(sizes=[2])
def example(
    places: harness.Folders = (),
    *,
    sizes: Sequence[harness.AtLeast2] = (10, 20),
    pair: tuple[harness.Natural, harness.Natural] | None = None,
    kinds: Annotated[Sequence[Annotated[str, ("one", "two")]], "*"] = ("one",),
    box: Annotated[Sequence[str], "append"] = (),
    weigh: bool = True,
    out: Path = Path("results"),
) -> int:
    """An example.

    - `sizes`: N, of
      all.
    """
    print(*places, sizes, pair, kinds, box, weigh, out)
    return sum(sizes)


def test_options_are_those_of_the_signature(capsys):
    assert example([]) == 30
    assert example(["--quick"]) == 2
    assert capsys.readouterr().out.endswith("results-quick\n")  # files of a full run stay
    assert example(["--quick", "--sizes", "3", "4"]) == 7
    given = ["here", "--pair", "0", "1", "--kinds", "--no-weigh", "--out", "there", "--box", "1"]
    assert example(given) == 30
    assert capsys.readouterr().out.splitlines()[-1] == "here (10, 20) [0, 1] [] ['1'] False there"
    for wrong, word in (
        (["--sizes", "1"], "from 2"),
        (["--pair", "1"], "expected 2"),
        (["--kinds", "three"], "invalid choice"),
    ):
        with pytest.raises(SystemExit, match="2"):
            example(wrong)
        assert word in capsys.readouterr().err
    with pytest.raises(SystemExit, match="0"):
        example(["--help"])
    assert "N, of all. (default: (10, 20))" in " ".join(capsys.readouterr().out.split())


def test_errors_and_intervals_are_those_of_scipy():
    values = np.random.default_rng(0).normal(1, 2, 40)
    mean, error = harness.mean_and_error(values)
    assert (mean, error) == pytest.approx((values.mean(), stats.sem(values)))
    assert harness.rms_and_error(values**2)[0] == pytest.approx(np.sqrt(np.mean(values**2)))
    others = values - 0.1 * values**2
    expected = stats.ttest_rel(values, others).statistic
    assert harness.worse(values, others) == pytest.approx(expected)
    interval = stats.binomtest(7, 20).proportion_ci(method="wilson")
    assert harness.wilson(7 / 20, 20) == pytest.approx([interval.low, interval.high])


def test_turns_are_timed_but_for_the_first_and_tables_have_dashes():
    clock, calls = iter(np.arange(100.0) ** 2), []
    runs = {name: lambda turn, name=name: calls.append((turn, name)) for name in "ab"}
    taken = harness.turns(runs, 3, clock=lambda: next(clock))
    assert sorted(calls) == [(turn, name) for turn in range(4) for name in "ab"]
    # The first two calls begin at 0 and 1, those that count are timed from begin to end.
    assert np.concatenate(list(taken.values())).sum() == sum(2 * k + 1 for k in range(2, 14, 2))
    assert harness.ratio(np.array([2.0, 9.0, 4.0]), np.array([1.0, 3.0])) == 2.5
    columns = {"n": "{n}", "x": "{x:.1f}"}
    lines = harness.table(columns, [{"n": 1, "x": 0.25}, {"n": 2, "x": None}]).splitlines()
    assert [line.split() for line in lines[2:]] == [["1", "0.2"], ["2", "-"]]
    entries = [{"a": a, "b": b} for a, b in ((1, 5), (2, 6), (1, 6))]
    lines = harness.pivot("", entries, "{a}", "b = {b}", lambda e: str(e["a"] * e["b"])).split("\n")
    assert [line.split() for line in lines[2:]] == [["1", "5", "6"], ["2", "-", "12"]]


def made_up(log_likelihood=-10.0, size=50.0, spread=0.3):
    """Twenty runs around these numbers; log E[Ẑ] is the given log-likelihood."""
    noise = np.random.default_rng(0).standard_normal((2, 20))
    noise = (noise - noise.mean(axis=1, keepdims=True)) / noise.std(axis=1, ddof=1, keepdims=True)
    return {
        "log_likelihoods": log_likelihood - spread**2 / 2 + spread * noise[0],
        "effective_sample_sizes": size + 0.5 * noise[1],
    }


def test_a_library_with_other_numbers_is_refused():
    ours, low = made_up(), made_up(log_likelihood=-11)
    for found, reference, reason in (
        (low, ours, "mean log likelihoods -11"),
        (made_up(size=53), ours, "mean effective sample sizes 53, not 50"),
        (low, low, "exactly -10"),
        (made_up(log_likelihood=np.nan), ours, "not finite"),
    ):
        assert reason in disagreement(found, reference, exact=-10.0)
    assert disagreement(made_up(-10.1, 50.2), ours, exact=-10.0) is None
