"""The tables as text: means over scenes beside the paper's, and what does not come out."""

from typing import Any

from benchmarks.partitioned_sampling.claims import recoveries
from benchmarks.partitioned_sampling.paper import HEADERS, paper_of
from benchmarks.partitioned_sampling.rates import RATES
from mpfjax.console import format_table

TITLES = {
    "joint": "joint PF (Non-PS)",
    "ps": "PS",
    "dps": "DPS",
    "dps_evidence": "DPS, evidence",
    "independent": "independent filters",
    "clusters": "clusters that merge on contact",
}


def print_tables(content: dict[str, Any]) -> None:
    """Every table with its intervals and the paper's figures, then what does not come out."""
    num = len(content["scenes"])
    titles = {
        "1": "table 1: the easy objects of the synthetic scenes",
        "2": "table 2: the distracted object of the synthetic scenes",
        "3": "tables 3 and 4: the hidden object of real sequences",
    }
    for table, means in content["means"].items():
        which = f"means over {num} scenes, ± their deviation" if num > 1 else "one scene"
        print(f"\n{titles[table]}; per cent, [95% interval], {which}")
        print(table_text(table, means))
        print("\n".join(_verdicts(f"table {table}", content["checks"], table)))
        if table != "1":
            print("\n".join(scene_lines(content, table)))
    print("\n".join(order_lines(content)))
    print("\nfigure 4 or 8: U/N in per cent, objects in their own order")
    for label, shares in content["uniqueness"].items():
        print(f"  {label:24s}" + " ".join(f"{100 * share:5.1f}" for share in shares))
    print("\n".join(_verdicts("figure 4", content["checks"], "figure 4")))


def table_text(table: str, means: list[dict[str, Any]]) -> str:
    """One table: each filter's means over scenes."""
    lines = [
        [f"{row['lambda']:g}", row_name(row), *[_cell(row, rate) for rate in RATES],
         paper_of(table, row), str(row["runs"])]
        for row in means
    ]  # fmt: skip
    return format_table(["λ", "filter", *RATES, f"paper: {HEADERS[table]}", "runs"], lines)


def row_name(row: dict[str, Any]) -> str:
    """The filter of a row of means."""
    name = str(TITLES.get(row["method"], row["method"]))
    ends: dict[Any, str] = {None: "", "mean": ", mean of orders"}
    ends["worst"] = ", worst order of each scene"
    return name + ends.get(row["order"], f", hard object {row['order']}")


def scene_lines(content: dict[str, Any], table: str) -> list[str]:
    """Each scene's recovery by every filter, the mean over λ."""
    names = ("joint", "PS mean", "dps", "dps_evidence", "independent", "clusters")
    columns = {name: recoveries(content, table, name) for name in names}
    columns = {name: found for name, found in columns.items() if found}
    verdict = ("left", "back", "exact_back")
    lines = [
        [str(scene["scene"]), *[str(scene.get(name, "-")) for name in verdict],
         *[f"{100 * found[scene['scene']]:.0f}" for found in columns.values()]]
        for scene in content["scenes"]
        if all(scene["scene"] in found for found in columns.values())
    ]  # fmt: skip
    header = ["scene", "posterior left", "back", "exactly", *columns]
    return ["recovery in per cent, means over λ:", format_table(header, lines)]


def order_lines(content: dict[str, Any]) -> list[str]:
    """What circular orders are, and what other orders are not."""
    lines = []
    for entry in content["circular_orders"]:
        lines.append(
            f"λ = {entry['lambda']:g}: the worst of a scene's {entry['num_orders']} circular orders"
            f" recovers in {100 * entry['least']:.1f}%, the best in {100 * entry['greatest']:.1f}%;"
            f" draws of one binomial: {100 * entry['expected_least']:.1f} and"
            f" {100 * entry['expected_greatest']:.1f}; all alike: p = {entry['p']:.2f}"
        )
    if lines:
        lines = [
            "",
            "Circular orders are one filter, read at different moments: an object's cycle is to"
            " move, to be weighed,",
            "and to be resampled by the others.",
            *lines,
        ]
    cycles = content["other_cycles"]
    if cycles:
        lines.append(
            f"λ = {cycles['lambda']:g}: {cycles['num_cycles']} other cycles recover in"
            f" {100 * cycles['worst']['recovery']:.1f}%"
            f" ({_arrows(cycles['worst']['order'])}) to {100 * cycles['best']['recovery']:.1f}%"
            f" ({_arrows(cycles['best']['order'])}), mean {100 * cycles['mean']:.1f}; draws of one"
            f" binomial: {100 * cycles['expected_least']:.1f} to"
            f" {100 * cycles['expected_greatest']:.1f}; all alike: p = {cycles['p']:.2g}"
        )
    return lines


def _arrows(order: list[int]) -> str:
    return "→".join(map(str, order))


def _cell(row: dict[str, Any], rate: str) -> str:
    low, high = (100 * end for end in row[f"{rate}_interval"])
    spread = f" ±{100 * row[f'{rate}_sd']:2.0f}" if f"{rate}_sd" in row else ""
    return f"{100 * row[rate]:3.0f} [{low:3.0f},{high:4.0f}]{spread}"


def _verdicts(name: str, checks: list[dict[str, Any]], table: str) -> list[str]:
    checks = [check for check in checks if check["table"] == table]
    failed = [check for check in checks if not check["holds"]]
    if not failed:
        return [f"{name}: comes out as asked" if checks else f"{name}: nothing to compare"]
    lines = [f"{name} does NOT come out as asked:"]
    for check in failed:
        where = "" if check["lambda"] is None else f"λ = {check['lambda']:g}: "
        lines.append(f"  {where}not so that {check['claim']} ({check['detail']})")
    return lines
