"""What is written and printed: every scene's rows, means over scenes, what becomes of orders."""

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import figures as plotting
from benchmarks import harness
from benchmarks.partitioned_sampling.rates import RATES, how_far_apart, over_scenes, shares_of
from benchmarks.partitioned_sampling.scenes import Scene
from benchmarks.partitioned_sampling.study import CYCLE

Rows = Sequence[dict[str, Any]]
KEYS = ("scene", "lambda", "method", "order")
TITLES = {
    "1": "table 1: the easy objects of the synthetic scenes",
    "2": "table 2: the distracted object of the synthetic scenes",
    "3": "tables 3 and 4: the hidden object of real sequences",
}
FILTERS = {
    "joint": "joint PF (Non-PS)",
    "ps": "PS",
    "dps": "DPS",
    "dps_evidence": "DPS, evidence",
    "independent": "independent filters",
    "clusters": "clusters that merge on contact",
}
# Of table 1: success, precision, recall; of 2: recovery, precision, recall; of 3 and 4: success,
# recovery, precision, recall of RealSeq1 | 2 | 3, PS by where the hidden object stands.
PAPER = {
    (row["table"], float(row["lambda"]), row["filter"]): row["figures"]
    for row in csv.DictReader((Path(__file__).parent / "paper.csv").open())
}
PAPER_RATES = {"1": "suc pre rcl", "2": "rcv pre rcl", "3": "suc rcv pre rcl, RealSeq1 | 2 | 3"}


def content_of(scenes: Sequence[Scene], rows: Rows) -> dict[str, Any]:
    """Tables, their summaries over orders, means over scenes, and figure 4 or 8."""
    plain = [row for row in rows if row["method"] != CYCLE]
    tables, summary, means = {}, {}, {}
    for name in scenes[0].tables:
        tables[name] = [_head(row) | shares_of(row["rates"][name]) for row in plain]
        summary[name] = _over_orders(name, [row for row in plain if row["method"] == "ps"])
        means[name] = _means(tables[name] + summary[name])
    return {
        "scenes": [
            {"scene": scene.key, "source": scene.name}
            | dict(zip(("left", "back"), scene.verdict or (), strict=False))
            for scene in scenes
        ],
        "tables": tables,
        "summary": summary,
        "means": means,
        "circular_orders": orders_of([row for row in plain if row["method"] == "ps"], True),
        "other_cycles": orders_of([row for row in rows if row["method"] == CYCLE], False),
        "figure_4": impoverishment(scenes, plain),
    }


def _head(row: dict[str, Any]) -> dict[str, Any]:
    return {name: row[name] for name in KEYS}


def _group(entries: Rows, *names: str) -> dict[tuple, list[dict[str, Any]]]:
    """The entries that have these values in common."""
    groups: dict[tuple, list[dict[str, Any]]] = {}
    for entry in entries:
        groups.setdefault(tuple(entry[name] for name in names), []).append(entry)
    return groups


def _over_orders(table: str, ps: Rows) -> list[dict[str, Any]]:
    """Of a scene's orders of PS: their mean, the worst, and by where the hard object stands.

    The worst recovers least, and of several that do, succeeds least.
    """
    entries = []
    for rows in _group(ps, "scene", "lambda").values():
        rates = [row["rates"][table] for row in rows]
        order = [(one["recovery"].mean(), one["success"].mean()) for one in rates]
        worst, last = order.index(min(order)), len(rows[0]["order"]) - 1
        chosen = {"mean": rates, "worst": [rates[worst]]}
        for place, at in {"first": 0, "middle": (last + 1) // 2, "last": last}.items():
            chosen[place] = [rates[[row["order"][at] for row in rows].index(1)]]
        entries += [
            _head(rows[0]) | {"order": name, "worst": rows[worst]["order"]} | shares_of(*runs)
            for name, runs in chosen.items()
        ]
    return entries


def _means(entries: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Means over scenes; of the orders only what a summary says of them."""
    named = [entry for entry in entries if not isinstance(entry["order"], list)]
    names = "lambda", "method", "order"
    groups = sorted(_group(named, *names).items(), key=lambda item: item[0][0])
    return [dict(zip(names, key, strict=True)) | over_scenes(group) for key, group in groups]


def orders_of(ps: Rows, circular: bool) -> list[dict[str, Any]]:
    """How far the hard object's recovery by these orders lies apart, for each λ."""
    entries = []
    for (lambda_,), rows in _group(ps, "lambda").items():
        scenes = [[row["rates"][list(row["rates"])[-1]]["recovery"] for row in group]
                  for group in _group(rows, "scene").values()]  # fmt: skip
        if len({len(orders) for orders in scenes}) > 1 or len(scenes[0]) < 2:
            continue  # as many orders as objects, which real scenes differ in
        shares = np.array(scenes).mean(axis=(2, 3))
        spread = how_far_apart(shares, scenes[0][0].size)
        orders = [str(row["order"]) for row in rows[: len(scenes[0])]]
        kind = "circular orders" if circular else "other cycles"
        recovery = dict(zip(orders, shares.mean(axis=0).tolist(), strict=True))
        entries.append({"lambda": lambda_, "kind": kind} | spread | {"recovery": recovery})
    return entries


def impoverishment(scenes: Sequence[Scene], rows: Rows) -> list[dict[str, Any]]:
    """Uniqueness and effective dynamics at the first λ, means over scenes of as many objects.

    Effective dynamics are the variances over the particles as shares of a step's. Objects stand in
    their own order; where scenes differ in number, those as the first.
    """
    deviations = {scene.key: scene.deviations for scene in scenes}
    values: dict[str, list[np.ndarray]] = {}
    orders = {}
    for row in rows:
        summary = row["kept"]
        if "uniqueness" not in summary or summary["boxes"].shape[2] != scenes[0].truth.shape[1]:
            continue
        reach = summary["variance"] / deviations[row["scene"]] ** 2
        shares = np.concatenate([summary["uniqueness"][..., None], reach], axis=-1)
        name = FILTERS[row["method"]]
        if row["order"] is not None:
            name += f" {{{'→'.join(map(str, row['order']))}}}"
        values.setdefault(name, []).append(shares.mean(axis=(0, 1)).T)
        orders[name] = row["order"]
    measures = "uniqueness", "dynamics_u", "dynamics_v"
    return [
        {"filter": name, "order": orders[name]}
        | dict(zip(measures, np.mean(shares_of_runs, axis=0), strict=True))
        for name, shares_of_runs in values.items()
    ]


def draw_impoverishment(entries: Sequence[dict[str, Any]]) -> Any:
    """Figures 4 and 8: uniqueness and effective dynamics of each object, in per cent.

    Of the orders only those with the hard object first and last.
    """
    measures = {
        "uniqueness": "uniqueness U/N [%]", "dynamics_u": "effective dynamics in u [%]",
        "dynamics_v": "effective dynamics in v [%]",
    }  # fmt: skip
    chosen = [e for e in entries if e["order"] is None or 1 in (e["order"][0], e["order"][-1])]
    panels = [
        plotting.Panel("", "object", label,
                       {e["filter"]: [*enumerate(100 * e[name], 1)] for e in chosen})
        for name, label in measures.items()
    ]  # fmt: skip
    return plotting.draw_panels([panels], ("linear", "linear"))


# --- as text, beside the paper's --------------------------------------------------------------


def print_tables(content: dict[str, Any]) -> None:
    """Every table with its intervals and the paper's figures."""
    num = len(content["scenes"])
    which = f"means over {num} scenes, ± their deviation" if num > 1 else "one scene"
    for table, means in content["means"].items():
        print(f"\n{TITLES[table]}; per cent, [95% interval], {which}")
        columns: dict[str, Any] = {"λ": "{lambda:g}", "filter": row_name}
        columns |= {rate: lambda row, rate=rate: _cell(row, rate) for rate in RATES}
        columns[f"paper: {PAPER_RATES[table]}"] = lambda row, table=table: PAPER.get(
            (table, row["lambda"], row["order"] or row["method"]), "-"
        )
        print(harness.table(columns | {"runs": "{runs}"}, means))
    print(f"recovery in per cent, means over λ:\n{scene_table(content, table)}")
    if orders := content["circular_orders"] + content["other_cycles"]:
        print("\nrecovery by the orders of PS; p: all are alike")
        columns = {"λ": "{lambda:g}", "orders": "{num_orders} {kind}", "mean": "{mean:.1%}"}
        columns |= {"worst": "{least:.1%}", "best": "{greatest:.1%}"}
        print(harness.table(columns | {"p": "{p:.2g}"}, orders))
    print("\nfigure 4 or 8: U/N in per cent, objects in their own order")
    objects = range(len(content["figure_4"][0]["uniqueness"]) if content["figure_4"] else 0)
    columns = {"filter": "{filter}"}
    columns |= {str(j + 1): lambda row, j=j: f"{100 * row['uniqueness'][j]:.1f}" for j in objects}
    print(harness.table(columns, content["figure_4"]))


def row_name(row: dict[str, Any]) -> str:
    """The filter of a row of means."""
    ends: dict[Any, str] = {None: "", "mean": ", mean of orders"}
    ends["worst"] = ", worst order of each scene"
    return FILTERS[row["method"]] + ends.get(row["order"], f", hard object {row['order']}")


def scene_table(content: dict[str, Any], table: str) -> str:
    """Each scene's recovery by every filter, the mean over λ."""
    scenes = {scene["scene"]: scene for scene in content["scenes"]}
    entries = content["tables"][table] + content["summary"][table]
    named = [entry for entry in entries if entry["order"] in (None, "mean")]
    means = [
        scenes[scene] | {"filter": method, "mean": np.mean([e["recovery"] for e in group])}
        for (scene, method), group in _group(named, "scene", "method").items()
    ]
    frames = ", posterior left in frame {left}, back in {back}" if table == "2" else ""
    cell = lambda entry: f"{100 * entry['mean']:.0f}"  # noqa: E731
    return harness.pivot("scene", means, "{scene}" + frames, "{filter}", cell)


def _cell(row: dict[str, Any], rate: str) -> str:
    low, high = (100 * end for end in row[f"{rate}_interval"])
    spread = f" ±{100 * row[f'{rate}_sd']:2.0f}" if f"{rate}_sd" in row else ""
    return f"{100 * row[rate]:3.0f} [{low:3.0f},{high:4.0f}]{spread}"
