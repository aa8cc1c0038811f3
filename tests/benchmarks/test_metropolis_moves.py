"""The filters are exact, and the table has a row for each."""

import json

import numpy as np
import pytest

from benchmarks import metropolis_moves
from tests.marking import thorough


def test_errors_are_those_of_the_numbers():
    found = metropolis_moves.errors(np.log([0.5, 1.5]))
    assert found["bias"] == pytest.approx(np.log(0.75) / 2)
    assert found["rms"] == pytest.approx(np.sqrt(np.mean(np.log([0.5, 1.5]) ** 2)))
    assert found["ratio"] == pytest.approx(1)
    assert found["ratio_error"] == pytest.approx(0.5 / np.sqrt(2))


@pytest.mark.parametrize("error", thorough(["0.5"]))
def test_a_row_for_each_filter_and_every_evidence_is_unbiased(error, tmp_path, capsys):
    arguments = [
        "--particles", "100", "--plain", "400", "--moves", "1", "--dimensions", "2", "--error",
        error, "--steps", "3", "--seeds", "400", "--repeats", "1", "--out", str(tmp_path),
    ]  # fmt: skip
    assert metropolis_moves.main(arguments) == 0
    results = json.loads((tmp_path / "metropolis_moves.json").read_text())["results"]
    moves = ("RandomWalkMetropolis", "MetropolisAdjustedLangevin")
    assert [(row["filter"], row["N"]) for row in results] == [
        ("plain", 400), *((f"{move}, 1 a stage", 100) for move in moves)
    ]  # fmt: skip
    for row in results:
        assert row["ms"] > 0
        assert 0 < row["ratio_error"] < 0.05
        assert abs(row["ratio"] - 1) < 4 * row["ratio_error"]
    assert "RMS of log Z-hat" in capsys.readouterr().out


def test_none_is_too_few(capsys):
    with pytest.raises(SystemExit):
        metropolis_moves.main(["--seeds", "1"])
    assert "--seeds: '1'" in capsys.readouterr().err
