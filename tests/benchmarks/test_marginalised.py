"""Each part has its rows, and all filters estimate the same probabilities of the regimes."""

import json

import numpy as np
import pytest

from benchmarks import marginalised


@pytest.mark.thorough
def test_a_row_for_each_move_and_filter(tmp_path, capsys):
    arguments = [
        "--particles", "8", "--sizes", "400", "--steps", "5", "--seeds", "2", "--repeats", "1",
        "--reference", "2000", "--out", str(tmp_path),
    ]  # fmt: skip
    assert marginalised.main(arguments) == 0
    results = json.loads((tmp_path / "marginalised.json").read_text())["results"]
    assert [row["move"] for row in results["time"]] == [
        "plain", "marginalised", "marginalised, mixed"
    ]  # fmt: skip
    assert all(row["ns a particle and step"] > 0 for row in results["time"])
    filters = {row["filter"]: row["RMS error"] for row in results["regimes"]}
    assert {"plain", "marginalised", "fully adapted", "all children"} <= filters.keys()
    assert 0 < max(filters.values()) < 0.1
    said = "dynamax is not there: pip install" in capsys.readouterr().out
    assert said != ("dynamax" in filters)


def test_errors_between_sizes_are_on_a_line_of_logarithms():
    taken = {("a", 10): 1.0, ("a", 100): 100.0}
    errors = {("a", 10): 0.4, ("a", 100): 0.1}
    assert marginalised._error_at(10.0, taken, errors, "a") == pytest.approx(np.sqrt(0.04))


def test_a_part_that_is_not_there_is_named(capsys):
    with pytest.raises(SystemExit):
        marginalised.main(["--parts", "space"])
    assert "space" in capsys.readouterr().err
