"""Rows are of fresh processes; what fails is named."""

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks import first_result
from benchmarks.first_result import Job, cold_and_kept, spent


def test_seconds_are_those_of_the_process(tmp_path):
    work = "sum(i * i for i in range(3_000_000))"
    found = spent(Job("work", command=("-c", work)), first_result.HERE, tmp_path, tmp_path)
    assert 0.05 < found.cpu < 20
    assert found.memory > 5
    script = 'print(\'{"cpu": 7.0, "wall": 8.0}\')'
    assert spent(Job("said", script=script), first_result.HERE, tmp_path, tmp_path)[:2] == (
        7.0,
        8.0,
    )


def test_processes_find_bytecode_as_installed_packages_have_it(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "1")
    (tmp_path / "tried.py").touch()
    job = Job(
        "import", command=("-c", f"import sys; sys.path += [{str(tmp_path)!r}]; import tried")
    )
    spent(job, first_result.HERE, tmp_path, tmp_path / "bytecode")
    assert list((tmp_path / "bytecode").rglob("tried.*.pyc"))


def test_a_process_that_fails_is_named(tmp_path):
    with pytest.raises(ValueError, match=r"broken: its process ended with 1: .*ZeroDivisionError"):
        spent(Job("broken", command=("-c", "1 / 0")), first_result.HERE, tmp_path, tmp_path)


@pytest.mark.thorough
def test_kept_programs_are_found_by_the_second_process(tmp_path):
    say = "import json; print(json.dumps({'cpu': 1.0 + n, 'wall': 1.0}))"
    make = "import jax, jax.numpy as jnp; jax.jit(lambda x: x @ x)(jnp.ones((3, 3)))"
    folder = "os.environ['JAX_COMPILATION_CACHE_DIR']"
    script = f"import os; n = len(os.listdir({folder}))\n{make}\n{say}"
    cold, kept = cold_and_kept(Job("programs", script=script), first_result.HERE, tmp_path)
    assert cold.cpu == 1.0
    assert kept.cpu > 1.0


@pytest.mark.thorough
def test_a_table_of_before_and_after(tmp_path, capsys):
    arguments = ["--only", "import", "--before", str(first_result.HERE), "--out", str(tmp_path)]
    assert first_result.main(arguments) == 0
    (row,) = json.loads((tmp_path / "first_result.json").read_text())["rows"]
    seconds = [row[name][part]["cpu"] for name in ("before", "now") for part in ("cold", "kept")]
    assert np.min(seconds) > 0.05
    assert "before, cold" in capsys.readouterr().out


def test_a_row_that_the_other_checkout_cannot_run_is_empty():
    part = {"cpu": 1.0, "wall": 2.0, "memory": 3.0}
    row = {"job": "new command", "before": None, "now": {"cold": part, "kept": part}}
    cells = first_result.lines([row], ["before", "now"]).split()
    assert cells == ["new", "command", "-", "1.0", "-", "1.0", "-", "2.0", "-", "3"]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [(["--before", "nowhere"], "--before: nowhere"), (["--rounds", "0"], "--rounds")],
)
def test_what_cannot_be_run_is_named(arguments, said, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit):
        first_result.main(arguments)
    assert said in capsys.readouterr().err


def test_the_commands_track_the_scene_that_was_rendered(tmp_path, monkeypatch):
    monkeypatch.setattr(first_result, "NUM_FRAMES", 3)
    scene = first_result.render(tmp_path / "scene")
    assert len(list((scene / "img").iterdir())) == 3
    jobs = first_result.jobs(scene, tmp_path / "out", tmp_path / "no data")
    for job in jobs:
        paths = [Path(part) for part in job.command if part.startswith(str(scene))]
        assert all(path.exists() for path in paths), job.name
    (box,) = {part for job in jobs for part in job.command if part.startswith("--box=")}
    assert min(float(value) for value in box.removeprefix("--box=").split(",")) >= 0
    assert not any("PETS" in job.name for job in jobs)
    (tmp_path / "data" / "pets09_s2l1").mkdir(parents=True)
    assert any("PETS" in job.name for job in first_result.jobs(scene, tmp_path, tmp_path / "data"))
