"""The program in C gives the plain filter's answer; the table has a row for each."""

import json
import shutil

import pytest

from benchmarks.hand_written_c import __main__ as hand_written_c

needs_gcc = pytest.mark.skipif(shutil.which("gcc") is None, reason="there is no gcc")


@needs_gcc
@pytest.mark.thorough
def test_a_row_for_each_number_of_particles(tmp_path, capsys):
    """Odd numbers of particles fill no vector; answers that differ would be an error."""
    arguments = ["--particles", "999", "1025", "--repeats", "2", "--out", str(tmp_path)]
    assert hand_written_c.main(arguments) == 0
    results = json.loads((tmp_path / "hand_written_c.json").read_text())
    assert [result["particles"] for result in results] == [999, 1025]
    assert "by the clock" in capsys.readouterr().out


def test_no_compiler_is_said(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(shutil, "which", lambda name: None)
    assert hand_written_c.main(["--out", str(tmp_path)]) != 0
    assert "gcc is not on the PATH" in capsys.readouterr().err
