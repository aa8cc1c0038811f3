"""What goes into the file: every scene's rows, means over scenes, and what becomes of orders."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

from benchmarks.partitioned_sampling.claims import checks_of
from benchmarks.partitioned_sampling.rates import (
    Rates,
    least_and_greatest,
    measure,
    over_scenes,
    pool,
    worst_order,
)
from benchmarks.partitioned_sampling.scenes import Scene
from benchmarks.partitioned_sampling.study import CYCLE, ORDERED, Order, Row

# Of the orders of a scene; "first", "middle" and "last" is where the hard object stands.
PLACES: dict[str, Callable[[int], int]] = {
    "first": lambda num_objects: 0,
    "middle": lambda num_objects: num_objects // 2,
    "last": lambda num_objects: num_objects - 1,
}


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
        table: measure(row.kept.boxes[:, :, chosen], scene.truth[:, chosen])
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
    content = {
        "scenes": [_scene_entry(scene) for scene in scenes],
        "tables": tables,
        "summary": summary,
        "means": means,
        "circular_orders": circular_orders_of([pair for pair in hard if pair[0].method != CYCLE]),
        "other_cycles": cycles_of([pair for pair in hard if pair[0].method == CYCLE]),
    } | impoverishment(scenes, [row for row, _ in measured])
    return content | {"checks": checks_of(content)}


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
    """Of a scene's orders of PS: their mean, the best and the worst, and by the object's place."""
    entries = []
    own = [pair for pair in measured if pair[0].scene == scene.key and pair[0].method in ORDERED]
    for method in ORDERED:
        for lambda_ in dict.fromkeys(row.lambda_ for row, _ in own):
            pairs = [pair for pair in own if (pair[0].lambda_, pair[0].method) == (lambda_, method)]
            head = {"scene": scene.key, "lambda": lambda_, "method": method}
            mean = pool([found for _, found in pairs])
            entries.append(head | {"order": "mean"} | mean.as_dict())
            row, found = pairs[worst_order([found for _, found in pairs])]
            worst = [j + 1 for j in row.order or ()]
            entries.append(head | {"order": "worst", "worst": worst} | found.as_dict())
            for place, rank in PLACES.items():
                at = rank(scene.num_objects)
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
        {"lambda": lambda_, "method": method, "order": order} | over_scenes(group)
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
        entries.append(
            {
                "lambda": lambda_,
                "num_orders": shares.shape[1],
                "least": float(shares.min(axis=1).mean()),
                "expected_least": float(least),
                "greatest": float(shares.max(axis=1).mean()),
                "expected_greatest": float(greatest),
                "p": alike(shares, num_runs),
            }
        )
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
        "lambda": measured[0][0].lambda_,
        "num_cycles": len(orders),
        "runs": num_runs,
        "mean": float(means.mean()),
        "best": {"order": named[int(means.argmax())], "recovery": float(means.max())},
        "worst": {"order": named[int(means.argmin())], "recovery": float(means.min())},
        "expected_greatest": greatest,
        "expected_least": least,
        "p": alike(shares, num_runs),
        "recovery": {",".join(map(str, o)): float(m) for o, m in zip(named, means, strict=True)},
    }


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
