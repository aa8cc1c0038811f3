"""Slopes are those of the numbers, and memory that of the programs."""

import json

import numpy as np
import pytest

import mpfjax
from benchmarks.scaling import __main__ as scaling
from benchmarks.scaling import cells, price, spread

ONLY_AXES = ["--devices", "--processes", "--no-price"]


@pytest.mark.parametrize("power", [0.0, 0.5, 1.0, 2.0])
def test_the_slope_of_a_power_law_is_its_power(power):
    sizes = [10, 40, 90, 1000]
    assert cells.fit_slope(sizes, [3 * size**power for size in sizes]) == pytest.approx(power)


def test_one_size_has_no_slope():
    assert cells.fit_slope([10], [1.0]) is None
    assert cells.fit_slope([10, 10], [1.0, 2.0]) is None


def test_slopes_are_found_for_each_filter_and_at_the_end():
    """1 + x grows like x in the end only; memory does not grow at all."""
    entries = [
        {"filter": name, "seeds": size, "median": start + size, "bytes": 7}
        for name, start in (("pf", 0.0), ("mpf", 100.0))
        for size in (10, 1000, 100_000)
    ]
    pf, mpf = cells.slopes_of("seeds", entries)
    assert (pf["filter"], mpf["filter"]) == ("pf", "mpf")
    assert pf["time"] == pytest.approx(1)
    assert mpf["time"] < 0.8
    assert mpf["time_last"] == pytest.approx(np.log(100_100 / 1100) / np.log(100))
    assert mpf["memory"] == pytest.approx(0, abs=1e-12)


def test_one_axis_is_varied_at_a_time():
    found = cells.cells_of("components", ["pf", "mpf_fixed"], cells.FULL)
    assert [cell.components for cell in found] == [1, 2, 12, 64]
    assert len({cell._replace(filter="", components=0) for cell in found}) == 1
    middle = cells.Cell("mpf", **cells.FULL.middle)
    assert all(middle in cells.cells_of(axis, ["mpf"], cells.FULL) for axis in cells.AXES)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The quick study of one axis."""
    out = tmp_path_factory.mktemp("scaling")
    arguments = ["--quick", "--repeats", "2", "--axes", "steps", "--filters", "pf"]
    assert scaling.main([*arguments, *ONLY_AXES, "--out", str(out)]) == 0
    return out, json.loads((out / "scaling.json").read_text())


def test_every_cell_is_there(finished):
    out, content = finished
    found = {(entry["filter"], entry["steps"]) for entry in content["results"]}
    assert found == {("pf", 4), ("pf", 8)}
    assert all(len(entry["seconds"]) == 2 for entry in content["results"])
    assert [slope["filter"] for slope in content["slopes"]] == ["pf"]
    assert content["spread"] == []
    assert (out / "scaling.png").stat().st_size > 5000


def test_memory_does_not_depend_on_the_steps_where_nothing_is_collected(finished):
    for slope in finished[1]["slopes"]:
        assert abs(slope["memory"]) < 0.05
    short, long = sorted(finished[1]["results"], key=lambda entry: entry["steps"])
    a_mixture = 12 * short["seeds"] * short["particles"]
    assert long["bytes"] - short["bytes"] < a_mixture / 2 * (long["steps"] - short["steps"])
    triangles = 2**17  # of the prefix sums, whatever N is
    assert long["bytes"] < 12 * a_mixture + triangles


def test_memory_grows_with_the_steps_where_all_is_collected(monkeypatch):
    monkeypatch.setattr(cells, "nothing", lambda mixture: mixture.particles)
    program = cells.compile_cell(cells.Cell("pf", 2000, 1, 2, steps=50))
    assert cells.bytes_of(program) >= 50 * 2000 * 2 * 4


@pytest.mark.parametrize("name", cells.FILTERS)
def test_a_filter_has_the_size_that_its_cell_says(name):
    filter, observations = cells.build(cells.Cell(name, 64, 4, 2, 5))
    assert isinstance(filter, mpfjax.Filter)
    assert filter.num_particles == 64
    assert filter.num_components == (1 if name == "pf" else 4)
    assert observations.shape == ((5, 4) if name == "dps" else (5,))


@pytest.mark.thorough
def test_processes_share_the_seeds():
    found = spread.spread_over("processes", [2], {"particles": 16, "seeds": 3}, repeats=1)
    assert [(entry["kind"], entry["number"]) for entry in found] == [("processes", 2)]
    assert found[0]["median"] > 0
    assert "processes (PF, N = 16, 3 seeds)" in spread.spread_table(
        "processes", found, {"particles": 16, "seeds": 3}
    )


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--repeats", "0"], "--repeats: '0'"),
        (["--devices", "0"], "--devices: '0'"),
        (["--filters", "kalman"], "--filters"),
    ],
)
def test_bad_options_are_refused_by_name(arguments, named, capsys):
    with pytest.raises(SystemExit):
        scaling.main(arguments)
    assert named in capsys.readouterr().err


def test_islands_alone(tmp_path, capsys):
    arguments = ["--axes", *ONLY_AXES, "--repeats", "1", "--out", str(tmp_path)]
    assert scaling.main([*arguments, "--islands", "192"]) == 0
    (found,) = json.loads((tmp_path / "scaling.json").read_text())["islands"]
    assert (found["particles"], len(found["seconds"])) == (192, 1)
    assert found["bytes"] > 0
    assert "memory" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        scaling.main([*arguments, "--islands", "81"])
    assert "--islands: 81" in capsys.readouterr().err


@pytest.mark.thorough
def test_the_price_is_in_units_of_the_plain_filter(tmp_path, capsys):
    arguments = ["--quick", "--repeats", "2", "--axes", "--devices", "--processes"]
    assert scaling.main([*arguments, "--out", str(tmp_path)]) == 0
    content = json.loads((tmp_path / "scaling.json").read_text())
    assert content["results"] == []
    sizes = {(e["filter"], e["particles"], e["components"]) for e in content["price"]}
    assert sizes == {(name, 64, m) for name in price.PRICED for m in (2, 4)}
    assert all(entry["ratio"] > 0 for entry in content["price"])
    calls = {(e["filter"], e["components"]): e["first_call"] for e in content["first_calls"]}
    assert set(calls) == {("pf", 1), *((name, m) for name in price.PRICED for m in (2, 4))}
    printed = capsys.readouterr().out
    ratio = next(e["ratio"] for e in content["price"] if e["filter"] == "mpf")
    assert f"{ratio:.2f}" in printed
    assert f"(its first call: {calls['pf', 1]:.1f} s)" in printed
