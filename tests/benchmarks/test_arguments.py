"""Command lines name the option that will not do, in one line and exit 2."""

import pytest

from benchmarks import histograms, score_vs_particles, tracking_speed
from benchmarks.gm_mpf import __main__ as gm_mpf
from benchmarks.hand_written_c import __main__ as hand_written_c
from benchmarks.interacting_objects import __main__ as interacting_objects
from benchmarks.likelihood_tuning import __main__ as likelihood_tuning
from benchmarks.partitioned_sampling import __main__ as partitioned_sampling
from benchmarks.peers import __main__ as peers
from benchmarks.scaling import __main__ as scaling
from benchmarks.smoothing import __main__ as smoothing
from benchmarks.visual_tracking import __main__ as visual_tracking

COUNTS = {
    gm_mpf: ["particles", "seeds"],
    hand_written_c: ["particles", "seeds", "threads", "repeats"],
    histograms: ["boxes", "size", "repeats"],
    interacting_objects: ["runs"],
    likelihood_tuning: ["runs", "particles", "starts", "steps", "label-runs", "label-steps"],
    partitioned_sampling: ["runs", "particles", "scenes", "event"],
    peers: ["particles", "seeds", "repeats", "devices"],
    scaling: ["islands", "repeats", "devices", "processes"],
    score_vs_particles: ["seeds", "particles", "components", "regroup-every"],
    smoothing: [
        "steps",
        "particles",
        "runs",
        "mode-particles",
        "seeds",
        "variance-particles",
        "variance-runs",
        "posterior-particles",
        "posterior-steps",
    ],
    tracking_speed: ["frames", "rounds"],
    visual_tracking: ["seeds"],
}
SEEDS = {
    gm_mpf: ["seed", "ids"],
    interacting_objects: ["seed"],
    likelihood_tuning: ["seed"],
    partitioned_sampling: ["seed", "scene", "ids"],
    score_vs_particles: ["seed", "data-seed"],
    smoothing: ["seed"],
    visual_tracking: ["seed", "ids"],
}
NUMBERS = {partitioned_sampling: ["lambdas"], peers: ["time-limit"]}


def cases(options, values):
    return [
        pytest.param(benchmark, option, value, id=f"{benchmark.__name__}-{option}-{value}")
        for benchmark, names in options.items()
        for option in names
        for value in values
    ]


def message_of(benchmark, capsys, *arguments):
    with pytest.raises(SystemExit) as caught:
        benchmark.main([str(argument) for argument in arguments])
    assert caught.value.code == 2
    return capsys.readouterr().err.splitlines()[-1]


@pytest.mark.parametrize(
    ("benchmark_", "option", "value"),
    [
        *cases(COUNTS, ["0", "-3", "1.5", "two", "99999999999999999999", ""]),
        *cases(SEEDS, ["-1", "1.5", "nan", "99999999999999999999", str(2**32)]),
        *cases(NUMBERS, ["0", "-1", "nan", "inf", "two"]),
    ],
)
def test_a_number_that_will_not_do_is_named(benchmark_, option, value, capsys):
    values = [value] * (2 if option in ("size", "ids") else 1)
    message = message_of(benchmark_, capsys, f"--{option}", *values)
    assert f"argument --{option}: {value!r} is not a " in message


@pytest.mark.parametrize(
    ("benchmark_", "arguments", "option"),
    [
        (likelihood_tuning, ["--parts", "b", "--runs", 3], "runs"),
        (likelihood_tuning, ["--parts", "b", "c", "--models", "quadratic"], "models"),
        (likelihood_tuning, ["--parts", "a", "--starts", 3], "starts"),
        (likelihood_tuning, ["--parts", "a", "b", "--label-steps", 3], "label-steps"),
        (partitioned_sampling, ["--event", 2], "event"),
        (partitioned_sampling, ["--sequence", "here", "--ids", 1, "--event", 1], "event"),
        (partitioned_sampling, ["--sensitivity", "--lambdas", 30], "lambdas"),
        (partitioned_sampling, ["--keys", "3:5", "--scenes", 2], "scenes"),
        (partitioned_sampling, ["--sequence", "here", "--scene", 3], "scene"),
    ],
)
def test_an_option_without_effect_is_named(benchmark_, arguments, option, capsys):
    message = message_of(benchmark_, capsys, *arguments)
    assert f"argument --{option}: does nothing " in message


def test_a_box_without_a_video_says_what_to_add(capsys):
    message = message_of(visual_tracking, capsys, "--box", "1,2,3,4")
    assert "argument --box: " in message
    assert "--video" in message
    assert "--sequence" in message
