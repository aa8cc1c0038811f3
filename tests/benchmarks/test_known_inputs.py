"""The table has a row for each filter and size, and other inputs trace nothing again."""

import json

import pytest

from benchmarks import known_inputs


@pytest.mark.thorough
def test_a_row_for_each_filter(tmp_path, capsys):
    arguments = ["--particles", "8", "--steps", "3", "--repeats", "2", "--out", str(tmp_path)]
    assert known_inputs.main(arguments) == 0
    results = json.loads((tmp_path / "known_inputs.json").read_text())["results"]
    assert [(row["filter"], row["N"]) for row in results] == [
        (name, 8) for name in known_inputs.FILTERS
    ]
    assert all(row["traced_again"] == 0 < row["median_ratio"] for row in results)
    assert "traced again" in capsys.readouterr().out


def test_none_is_too_few(capsys):
    with pytest.raises(SystemExit):
        known_inputs.main(["--repeats", "1"])
    assert "--repeats: '1'" in capsys.readouterr().err
