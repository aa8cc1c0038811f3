"""What is written and printed: every scene's rows, means over scenes, what becomes of orders."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

from benchmarks import harness
from benchmarks.partitioned_sampling import rates as of_runs
from benchmarks.partitioned_sampling.rates import RATES, Rates, least_and_greatest
from benchmarks.partitioned_sampling.scenes import Scene
from benchmarks.partitioned_sampling.study import CYCLE, ORDERED, Order, Row


class Measured(NamedTuple):
    """A row, and its rates in each table."""

    row: Row
    rates: dict[str, Rates]


def measure_row(scene: Scene, row: Row, synthetic: bool) -> Measured:
    """The hard object's rates, and on synthetic scenes those of the others."""
    objects = {"3": [scene.hard]}
    if synthetic:
        objects = {"1": [j for j in range(scene.num_objects) if j != scene.hard]}
        objects["2"] = [scene.hard]
    rates = {
        table: of_runs.measure(row.kept.boxes[:, :, chosen], scene.truth[:, chosen])
        for table, chosen in objects.items()
    }
    return Measured(row, rates)


def content_of(scenes: Sequence[Scene], measured: Sequence[Measured]) -> dict[str, Any]:
    """Tables, their summaries over orders, means over scenes, and figure 4 or 8."""
    tables, summary, means = {}, {}, {}
    for table in measured[0].rates:
        own = [(row, rates[table]) for row, rates in measured if row.method != CYCLE]
        tables[table] = [table_row(row, found) for row, found in own]
        summary[table] = [entry for scene in scenes for entry in _over_orders(scene, own)]
        means[table] = _means(tables[table] + summary[table])
    hard = [(row, rates[table]) for row, rates in measured]  # the last table is the hard object's
    return {
        "scenes": [_scene_entry(scene) for scene in scenes],
        "tables": tables,
        "summary": summary,
        "means": means,
        "circular_orders": circular_orders_of([pair for pair in hard if pair[0].method != CYCLE]),
        "other_cycles": cycles_of([pair for pair in hard if pair[0].method == CYCLE]),
    } | impoverishment(scenes, [row for row, _ in measured])


def table_row(row: Row, rates: Rates) -> dict[str, Any]:
    """One entry of a table of the JSON file."""
    order = None if row.order is None else [j + 1 for j in row.order]
    head = {"scene": row.scene, "lambda": row.lambda_, "method": row.method, "order": order}
    return head | rates.as_dict()


def label(method: str, order: Order) -> str:
    """The name of a row: "ps 2,3,1", "dps"."""
    return method + ("" if order is None else " " + ",".join(str(j + 1) for j in order))


def _scene_entry(scene: Scene) -> dict[str, Any]:
    entry: dict[str, Any] = {"scene": scene.key, "source": scene.name}
    if scene.verdict is not None:
        entry |= {"left": scene.verdict.left, "back": scene.verdict.back}
    if scene.exact is not None:
        entry |= {"exact_left": scene.exact.left, "exact_back": scene.exact.back}
    return entry


def _over_orders(scene: Scene, measured: list[tuple[Row, Rates]]) -> list[dict[str, Any]]:
    """Of a scene's orders of PS: their mean, the worst, and by where the hard object stands.

    The worst recovers least, and of several that do, succeeds least.
    """
    entries = []
    own = [pair for pair in measured if pair[0].scene == scene.key and pair[0].method in ORDERED]
    for lambda_ in dict.fromkeys(row.lambda_ for row, _ in own):
        pairs = [(row, found) for row, found in own if row.lambda_ == lambda_]
        head = {"scene": scene.key, "lambda": lambda_, "method": pairs[0][0].method}
        entries.append(
            head | {"order": "mean"} | of_runs.pool([found for _, found in pairs]).as_dict()
        )
        row, found = min(pairs, key=lambda p: (p[1].recovered.mean(), p[1].success.mean()))
        worst = [j + 1 for j in row.order or ()]
        entries.append(head | {"order": "worst", "worst": worst} | found.as_dict())
        ends = {"first": 0, "middle": scene.num_objects // 2, "last": scene.num_objects - 1}
        for place, at in ends.items():
            found = next(r for row, r in pairs if row.order and row.order[at] == scene.hard)
            entries.append(head | {"order": place} | found.as_dict())
    return entries


def _means(entries: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Means over scenes; of the orders only what a summary says of them."""
    grouped: dict[tuple, list[dict[str, Any]]] = {}
    for entry in entries:
        if not isinstance(entry["order"], list):
            key = (entry["lambda"], entry["method"], entry["order"])
            grouped.setdefault(key, []).append(entry)
    return [
        {"lambda": lambda_, "method": method, "order": order} | of_runs.over_scenes(group)
        for (lambda_, method, order), group in sorted(grouped.items(), key=lambda item: item[0][0])
    ]


# --- orders -----------------------------------------------------------------------------------


def circular_orders_of(measured: list[tuple[Row, Rates]]) -> list[dict[str, Any]]:
    """How far the circular orders lie apart, beside draws of one binomial, for each λ.

    `least` and `greatest` are of each scene's orders, averaged over scenes; `p` is that of the
    test that all orders of a scene recover alike.
    """
    entries = []
    own = [(row, found) for row, found in measured if row.method in ORDERED]
    for lambda_ in dict.fromkeys(row.lambda_ for row, _ in own):
        counts, num_runs = _counts([pair for pair in own if pair[0].lambda_ == lambda_])
        if len({len(count) for count in counts}) > 1 or len(counts[0]) < 2:
            continue  # as many orders as objects, which real scenes differ in
        shares = np.array(counts) / num_runs
        expected = [least_and_greatest([share.mean()], num_runs, len(share)) for share in shares]
        least, greatest = np.mean(expected, axis=0)
        entries.append({
            "lambda": lambda_, "num_orders": shares.shape[1], "p": alike(shares, num_runs),
            "least": shares.min(axis=1).mean(), "expected_least": least,
            "greatest": shares.max(axis=1).mean(), "expected_greatest": greatest,
        })  # fmt: skip
    return entries


def cycles_of(measured: list[tuple[Row, Rates]]) -> dict[str, Any]:
    """Orders that are no circular shifts of each other: recovery over all scenes."""
    if not measured:
        return {}
    counts, num_runs = _counts(measured)
    shares = np.array(counts) / num_runs
    orders = list(dict.fromkeys(row.order for row, _ in measured))
    means = shares.mean(axis=0)
    least, greatest = least_and_greatest(shares.mean(axis=1).tolist(), num_runs, len(orders))
    named = [[j + 1 for j in order or ()] for order in orders]
    return {
        "lambda": measured[0][0].lambda_, "num_cycles": len(orders), "runs": num_runs,
        "mean": means.mean(), "expected_greatest": greatest, "expected_least": least,
        "best": {"order": named[int(means.argmax())], "recovery": means.max()},
        "worst": {"order": named[int(means.argmin())], "recovery": means.min()},
        "p": alike(shares, num_runs),
        "recovery": {",".join(map(str, o)): m for o, m in zip(named, means, strict=True)},
    }  # fmt: skip


def alike(shares: np.ndarray, num_runs: int) -> float:
    """The probability of totals at least as uneven, if in each scene all orders recover alike.

    `shares` is (scenes, orders); a χ² test of the orders' sums over scenes.
    """
    own = shares.mean(axis=1)
    variance = (own * (1 - own)).sum() / num_runs
    if variance == 0:
        return 1.0
    totals = shares.sum(axis=0)
    statistic = ((totals - totals.mean()) ** 2).sum() / variance
    return float(stats.chi2.sf(statistic, shares.shape[1] - 1))


def _counts(measured: list[tuple[Row, Rates]]) -> tuple[list[np.ndarray], int]:
    """How many runs recover, an array over orders for each scene, and of how many."""
    scenes: dict[int | str, list[int]] = {}
    for row, found in measured:
        scenes.setdefault(row.scene, []).append(int(found.recovered[:, 0].sum()))
    return [np.array(count) for count in scenes.values()], len(measured[0][1].count)


# --- figure 4 ---------------------------------------------------------------------------------


def impoverishment(scenes: Sequence[Scene], rows: Sequence[Row]) -> dict[str, Any]:
    """Uniqueness and effective dynamics at the first λ, means over scenes of as many objects.

    Objects stand in their own order; where scenes differ in number, those as the first.
    """
    deviations = {scene.key: scene.deviations for scene in scenes}
    size = scenes[0].num_objects
    kept: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}
    for row in rows:
        if row.kept.uniqueness is None or row.kept.uniqueness.shape[-1] != size:
            continue
        dynamics = row.kept.dynamics / deviations[row.scene] ** 2
        values = (row.kept.uniqueness.mean(axis=(0, 1)), dynamics.mean(axis=(0, 1)))
        kept.setdefault(label(row.method, row.order), []).append(values)
    shares = {name: np.mean([u for u, _ in found], axis=0) for name, found in kept.items()}
    reach = {name: np.mean([d for _, d in found], axis=0) for name, found in kept.items()}
    return {
        "uniqueness": {name: values.tolist() for name, values in shares.items()},
        "effective_dynamics": {
            name: {axis: values[:, i].tolist() for i, axis in enumerate("uv")}
            for name, values in reach.items()
        },
    }


# --- the tables as text, beside the paper's ------------------------------------------------------

# Table 1: success, precision, recall; table 2: recovery, precision, recall; tables 3 and 4:
# success, recovery, precision, recall, PS by where the hidden object stands in the order.
PAPER_TABLE_1 = {
    20: {"joint": (97, 69, 69), "mean": (100, 90, 87), "dps": (100, 91, 86)},
    30: {"joint": (97, 69, 68), "mean": (100, 91, 87), "dps": (100, 90, 86)},
    40: {"joint": (93, 68, 68), "mean": (100, 91, 88), "dps": (100, 90, 87)},
    50: {"joint": (96, 67, 66), "mean": (100, 91, 88), "dps": (100, 90, 87)},
}
PAPER_TABLE_2 = {
    20: {"joint": (2, 27, 28), "mean": (19, 27, 26), "worst": (10, 17, 16), "dps": (42, 41, 36)},
    30: {"joint": (2, 21, 21), "mean": (18, 24, 24), "worst": (8, 16, 16), "dps": (34, 36, 36)},
    40: {"joint": (0, 23, 22), "mean": (21, 30, 29), "worst": (16, 18, 17), "dps": (38, 21, 22)},
    50: {"joint": (2, 24, 23), "mean": (21, 28, 28), "worst": (12, 25, 24), "dps": (36, 23, 23)},
}
PAPER_TABLE_3 = (  # RealSeq1, 2 and 3
    {"joint": (32, 78, 59, 98), "first": (18, 18, 60, 98), "last": (40, 96, 58, 98),
     "dps": (100, 100, 62, 100)},
    {"joint": (10, 32, 72, 86), "first": (0, 8, 55, 91), "last": (12, 40, 72, 86),
     "dps": (78, 88, 58, 98)},
    {"joint": (4, 8, 41, 70), "first": (70, 72, 51, 86), "last": (26, 28, 46, 77),
     "dps": (36, 38, 51, 79)},
)  # fmt: skip
HEADERS = {
    "1": "suc pre rcl",
    "2": "rcv pre rcl",
    "3": "suc rcv pre rcl, RealSeq1 | 2 | 3",
}


def paper_of(table: str, row: dict[str, Any]) -> str:
    """What the paper has in the place of a row of means, or a dash."""
    name = row["method"] if row["order"] is None else row["order"]
    if table == "3":
        found = [figures[name] for figures in PAPER_TABLE_3 if name in figures]
    else:
        figures = {"1": PAPER_TABLE_1, "2": PAPER_TABLE_2}[table].get(round(row["lambda"]), {})
        found = [figures[name]] if name in figures else []
    return " | ".join(" ".join(f"{value:3d}" for value in line) for line in found) or "-"


TITLES = {
    "joint": "joint PF (Non-PS)",
    "ps": "PS",
    "dps": "DPS",
    "dps_evidence": "DPS, evidence",
    "independent": "independent filters",
    "clusters": "clusters that merge on contact",
}


def print_tables(content: dict[str, Any]) -> None:
    """Every table with its intervals and the paper's figures."""
    num = len(content["scenes"])
    titles = {
        "1": "table 1: the easy objects of the synthetic scenes",
        "2": "table 2: the distracted object of the synthetic scenes",
        "3": "tables 3 and 4: the hidden object of real sequences",
    }
    for name, means in content["means"].items():
        which = f"means over {num} scenes, ± their deviation" if num > 1 else "one scene"
        print(f"\n{titles[name]}; per cent, [95% interval], {which}")
        columns: dict[str, Any] = {"λ": "{lambda:g}", "filter": row_name}
        columns |= {rate: lambda row, rate=rate: _cell(row, rate) for rate in RATES}
        columns[f"paper: {HEADERS[name]}"] = lambda row, name=name: paper_of(name, row)
        print(harness.table(columns | {"runs": "{runs}"}, means))
        if name != "1":
            print("recovery in per cent, means over λ:")
            print(scene_table(content, name))
    print("\n".join(order_lines(content)))
    print("\nfigure 4 or 8: U/N in per cent, objects in their own order")
    for label, shares in content["uniqueness"].items():
        print(f"  {label:24s}" + " ".join(f"{100 * share:5.1f}" for share in shares))


def row_name(row: dict[str, Any]) -> str:
    """The filter of a row of means."""
    name = str(TITLES.get(row["method"], row["method"]))
    ends: dict[Any, str] = {None: "", "mean": ", mean of orders"}
    ends["worst"] = ", worst order of each scene"
    return name + ends.get(row["order"], f", hard object {row['order']}")


def scene_table(content: dict[str, Any], name: str) -> str:
    """Each scene's recovery by every filter, the mean over λ."""
    found: dict[Any, dict[str, list[float]]] = {}
    for entry in content["tables"][name] + content["summary"][name]:
        method = "PS mean" if entry["order"] == "mean" else entry["method"]
        if entry["order"] in (None, "mean"):
            found.setdefault(entry["scene"], {}).setdefault(method, []).append(entry["recovery"])
    columns: dict[str, Any] = {
        "scene": "{scene}", "posterior left": "{left}", "back": "{back}", "exactly": "{exact_back}"
    }  # fmt: skip
    for method in next(iter(found.values())):
        columns[method] = lambda row, method=method: f"{100 * np.mean(row['by'][method]):.0f}"
    rows = [scene | {"by": found[scene["scene"]]} for scene in content["scenes"]]
    return harness.table(columns, rows)


def order_lines(content: dict[str, Any]) -> list[str]:
    """What circular orders are, one filter read at different moments, and what others are not."""
    arrows = lambda order: "→".join(map(str, order))  # noqa: E731
    lines = [
        f"λ = {e['lambda']:g}: the worst of a scene's {e['num_orders']} circular orders"
        f" recovers in {e['least']:.1%}, the best in {e['greatest']:.1%};"
        f" draws of one binomial: {e['expected_least']:.1%} and"
        f" {e['expected_greatest']:.1%}; all alike: p = {e['p']:.2f}"
        for e in content["circular_orders"]
    ]
    if cycles := content["other_cycles"]:
        worst, best = cycles["worst"], cycles["best"]
        lines.append(
            f"λ = {cycles['lambda']:g}: {cycles['num_cycles']} other cycles recover in"
            f" {worst['recovery']:.1%} ({arrows(worst['order'])}) to {best['recovery']:.1%}"
            f" ({arrows(best['order'])}), mean {cycles['mean']:.1%}; draws of one binomial:"
            f" {cycles['expected_least']:.1%} to {cycles['expected_greatest']:.1%};"
            f" all alike: p = {cycles['p']:.2g}"
        )
    return lines


def _cell(row: dict[str, Any], rate: str) -> str:
    low, high = (100 * end for end in row[f"{rate}_interval"])
    spread = f" ±{100 * row[f'{rate}_sd']:2.0f}" if f"{rate}_sd" in row else ""
    return f"{100 * row[rate]:3.0f} [{low:3.0f},{high:4.0f}]{spread}"
