"""Tables 1 to 4 of Smith and Gatica-Perez (2004): rates with intervals, beside the paper's."""

from collections.abc import Sequence
from statistics import NormalDist
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mpfjax.console import format_table
from mpfjax.metrics.tracking_quality import (
    precision,
    recall,
    recovery_rate,
    success_rate,
    track_state,
)

# Recovered is who is tracked in each of the last frames: one alone may be a brush in passing.
NUM_LAST = 3
_Z = NormalDist().inv_cdf(0.975)

# Per cent. Table 1: success, precision, recall; table 2: recovery, precision, recall; tables 3
# and 4: success, recovery, precision, recall. PS by where the hard object stands in the order.
PAPER_TABLE_1 = {
    20: {"joint": (97, 69, 69), "ps": (100, 90, 87), "dps": (100, 91, 86)},
    30: {"joint": (97, 69, 68), "ps": (100, 91, 87), "dps": (100, 90, 86)},
    40: {"joint": (93, 68, 68), "ps": (100, 91, 88), "dps": (100, 90, 87)},
    50: {"joint": (96, 67, 66), "ps": (100, 91, 88), "dps": (100, 90, 87)},
}
PAPER_TABLE_2 = {
    20: {"joint": (2, 27, 28), "mean": (19, 27, 26), "worst": (10, 17, 16), "dps": (42, 41, 36)},
    30: {"joint": (2, 21, 21), "mean": (18, 24, 24), "worst": (8, 16, 16), "dps": (34, 36, 36)},
    40: {"joint": (0, 23, 22), "mean": (21, 30, 29), "worst": (16, 18, 17), "dps": (38, 21, 22)},
    50: {"joint": (2, 24, 23), "mean": (21, 28, 28), "worst": (12, 25, 24), "dps": (36, 23, 23)},
}
PAPER_TABLE_3 = {
    "RealSeq1": {
        "joint": (32, 78, 59, 98), 0: (18, 18, 60, 98), 1: (34, 52, 62, 99),
        2: (40, 96, 58, 98), "dps": (100, 100, 62, 100),
    },
    "RealSeq2": {
        "joint": (10, 32, 72, 86), 0: (0, 8, 55, 91), 1: (0, 8, 59, 91),
        2: (12, 40, 72, 86), "dps": (78, 88, 58, 98),
    },
}  # fmt: skip
PAPER_TABLE_4 = {
    "RealSeq3": {
        "joint": (4, 8, 41, 70), 0: (70, 72, 51, 86), 1: (84, 88, 51, 87),
        2: (82, 86, 52, 87), 3: (26, 28, 46, 77), "dps": (36, 38, 51, 79),
    }
}  # fmt: skip


class Rates(NamedTuple):
    """What the runs of one filter, or of several, came to, for one or more objects."""

    success: np.ndarray  # (runs, objects), tracked in every frame
    recovered: np.ndarray  # (runs, objects), tracked in the last frames
    precision: np.ndarray  # (runs,), sums over the objects' frames with T = 1
    recall: np.ndarray  # (runs,)
    count: np.ndarray  # (runs,), how many such frames

    def as_dict(self) -> dict[str, Any]:
        """Shares in [0, 1], each with a 95% interval.

        Success and recovery have Wilson's, with as many trials as runs: the objects of one run
        share its particles, and are no trials of their own. Precision and recall, which are
        ratios of sums over runs, have the normal one.
        """
        rates: dict[str, Any] = {}
        intervals: dict[str, Any] = {}
        num_runs = len(self.count)
        for name, outcomes in (("success", self.success), ("recovery", self.recovered)):
            rates[name] = float(outcomes.mean())
            intervals[f"{name}_interval"] = wilson(rates[name], num_runs)
        for name, sums in (("precision", self.precision), ("recall", self.recall)):
            rates[name], intervals[f"{name}_interval"] = ratio(sums, self.count)
        return rates | {"runs": num_runs} | intervals


def measure(estimates: np.ndarray, truth: np.ndarray) -> Rates:
    """The measures of section 3.1 from boxes (runs, t, objects, 4) and (t, objects, 4)."""
    truth = np.asarray(truth, estimates.dtype)
    present = jnp.asarray(np.isfinite(truth).all(axis=-1))
    states = track_state(jnp.asarray(estimates), jnp.asarray(truth[None]))

    def outcomes(states):
        recovery = recovery_rate(states[None], present, num_last=NUM_LAST)
        return success_rate(states[None], present), recovery

    success, recovered = (np.asarray(found) > 0.5 for found in jax.vmap(outcomes)(states))
    boxes, places = jnp.asarray(estimates), jnp.asarray(truth[None])
    inside, covered = (
        np.asarray(share(boxes, places)).sum(axis=(1, 2)) for share in (precision, recall)
    )
    return Rates(success, recovered, inside, covered, np.asarray(states).sum(axis=(1, 2)))


def pool(rates: Sequence[Rates]) -> Rates:
    """All runs of several filters."""
    return Rates(*(np.concatenate(parts) for parts in zip(*rates, strict=True)))


def worst_order(rates: Sequence[Rates]) -> int:
    """Which recovers least, and of several that do, which succeeds least."""
    return min(
        range(len(rates)), key=lambda i: (rates[i].recovered.mean(), rates[i].success.mean())
    )


def wilson(share: float, num_trials: int) -> list[float]:
    """Wilson's 95% interval of a probability, from the share of trials that came true."""
    middle = share + _Z**2 / (2 * num_trials)
    reach = _Z * np.sqrt(share * (1 - share) / num_trials + _Z**2 / (4 * num_trials**2))
    scale = 1 + _Z**2 / num_trials
    return [float(max((middle - reach) / scale, 0)), float(min((middle + reach) / scale, 1))]


def ratio(sums: np.ndarray, counts: np.ndarray) -> tuple[float, list[float]]:
    """Σ s_r / Σ c_r over runs r and its 95% interval; 0, and all of [0, 1], for no counts."""
    num_runs, total = len(counts), counts.sum()
    if total == 0:
        return 0.0, [0.0, 1.0]
    value = float(sums.sum() / total)
    if num_runs == 1:
        return value, [0.0, 1.0]
    spread = ((sums - value * counts) ** 2).sum() * num_runs / (num_runs - 1)
    reach = _Z * float(np.sqrt(spread)) / float(total)
    return value, [max(value - reach, 0.0), min(value + reach, 1.0)]


# --- what the paper found, and whether it is found here ---------------------------------------


def checks_of(content: dict[str, Any]) -> list[dict[str, Any]]:
    """The paper's findings, each with whether it holds here and the figures that say so.

    `clear` tells whether the two intervals are apart, where two rates are compared.
    """
    found = []
    for table, rows in content["tables"].items():
        for lambda_ in dict.fromkeys(row["lambda"] for row in rows):
            named = {row["method"]: row for row in rows if row["lambda"] == lambda_}
            of_orders = [row for row in content["summary"][table] if row["lambda"] == lambda_]
            named |= {f"PS {row['order']}": row for row in of_orders}
            for claim in _CLAIMS[table]:
                if all(name in named for name in claim[:2]):
                    found.append({"table": table, "lambda": lambda_} | _check(table, claim, named))
    return found + _uniqueness_checks(content["uniqueness"])


# Name, name, rate, by how much the first is above the second.
_CLAIMS = {
    "1": [
        ("PS mean", "joint", "success", 0.0),
        ("dps", "joint", "success", 0.0),
        ("PS mean", "joint", "precision", 0.15),
        ("PS mean", "joint", "recall", 0.15),
        ("dps", "joint", "precision", 0.15),
        ("dps", "joint", "recall", 0.15),
    ],
    "2": [
        ("PS mean", "joint", "recovery", 0.0),
        ("dps", "PS mean", "recovery", 0.0),
        ("dps", "PS worst", "recovery", 0.0),
    ],
    "3": [
        ("dps", "PS mean", "recovery", 0.0),
        ("dps", "PS worst", "recovery", 0.0),
        ("dps", "joint", "recovery", 0.0),
    ],
    "4": [
        ("PS mean", "dps", "recovery", 0.0),
        ("dps", "PS worst", "recovery", 0.0),
        ("dps", "joint", "recovery", 0.0),
    ],
}
_WHOLE = {"1": ("PS mean", "dps")}


def _check(table: str, claim: tuple[str, str, str, float], named: dict) -> dict[str, Any]:
    upper, lower, rate, margin = claim
    high, low = named[upper][rate], named[lower][rate]
    words = f"{upper} has {100 * margin:.0f} points or more of {rate} above {lower}"
    holds = high - low >= margin
    if margin == 0:
        words = f"{upper} has a higher {rate} than {lower}"
        holds = high > low
    if rate == "success" and upper in _WHOLE.get(table, ()):
        words = f"{upper} has a success of 100%, {lower} has less"
        holds = high == 1 and low < 1
    apart = named[upper][f"{rate}_interval"][0] > named[lower][f"{rate}_interval"][1]
    detail = f"{100 * high:.0f} against {100 * low:.0f}"
    return {"claim": words, "holds": bool(holds), "clear": bool(apart), "detail": detail}


def _uniqueness_checks(uniqueness: dict[str, list[float]]) -> list[dict[str, Any]]:
    found = []
    for name, shares in uniqueness.items():
        method, _, order = name.partition(" ")
        if order:
            stages = [shares[int(j) - 1] for j in order.split(",")]
            claim = f"uniqueness falls towards the first stage under {name}"
            holds = all(np.diff(stages) > 0)
        elif method.startswith("dps"):
            claim = f"no object has less than half of another's uniqueness under {name}"
            holds = min(shares) >= max(shares) / 2
        else:
            continue
        detail = ", ".join(f"{100 * share:.0f}" for share in shares)
        found.append({"table": "figure 4", "lambda": None, "claim": claim, "holds": bool(holds),
                      "clear": bool(holds), "detail": detail})  # fmt: skip
    return found


# --- as text ----------------------------------------------------------------------------------


def print_tables(name: str, hard: int, num_objects: int, content: dict[str, Any]) -> None:
    """Every table with its intervals and the paper's figures, then what does not come out."""
    titles = {
        "1": f"table 1: objects 2-{num_objects} of the {name}",
        "2": f"table 2: object 1 of the {name}",
        "3": f"table 3: object {hard + 1} of {name}",
        "4": f"table 4: object {hard + 1} of {name}",
    }
    for table, rows in content["tables"].items():
        print(f"\n{titles[table]}; per cent, [95% interval]")
        print(table_text(table, hard, rows, content["summary"][table]))
        checks = [check for check in content["checks"] if check["table"] == table]
        print("\n".join(_verdicts(f"table {table}", checks)))
    print("\nfigure 4 or 8: U/N in per cent, objects in their own order")
    for label, shares in content["uniqueness"].items():
        print(f"  {label:24s}" + " ".join(f"{100 * share:5.1f}" for share in shares))
    checks = [check for check in content["checks"] if check["table"] == "figure 4"]
    print("\n".join(_verdicts("figure 4", checks)))


def table_text(table: str, hard: int, rows: list[dict], summary: list[dict]) -> str:
    """One table; PS in every order, their mean and the worst."""
    lines = []
    for lambda_ in dict.fromkeys(row["lambda"] for row in rows):
        entries = [row for row in rows if row["lambda"] == lambda_]
        entries += [row for row in summary if row["lambda"] == lambda_]
        for row in entries:
            cells = [_with_interval(row, rate) for rate in _RATES]
            lines.append(
                [
                    f"{lambda_:g}",
                    row_name(row),
                    *cells,
                    paper_of(table, hard, row),
                    str(row["runs"]),
                ]
            )
    header = ["λ", "filter", *_RATES, f"paper: {_PAPER_HEADERS[table]}", "runs"]
    return format_table(header, lines)


_RATES = ("success", "recovery", "precision", "recall")
_PAPER_HEADERS = {
    "1": "suc pre rcl",
    "2": "rcv pre rcl",
    "3": "suc rcv pre rcl, RealSeq1 | 2",
    "4": "suc rcv pre rcl, RealSeq3",
}


def row_name(row: dict[str, Any]) -> str:
    """The filter of a row, and its order."""
    order = row["order"]
    if order is None:
        return row["method"]
    if isinstance(order, str):
        which = "→".join(map(str, row.get("worst", [])))
        return f"{row['method']}, {order}" + (f" ({which})" if which else "")
    return f"{row['method']} " + "→".join(map(str, order))


def paper_of(table: str, hard: int, row: dict[str, Any]) -> str:
    """What the paper has in this place, or a dash."""
    method, order = row["method"], row["order"]
    if table in ("1", "2"):
        places = {"1": {"mean": "ps"}, "2": {"mean": "mean", "worst": "worst"}}[table]
        name = method if order is None else places.get(order) if isinstance(order, str) else None
        figures = {"1": PAPER_TABLE_1, "2": PAPER_TABLE_2}[table].get(round(row["lambda"]), {})
        found = [figures[name]] if name in figures else []
    else:
        found = [
            figures[place]
            for figures in {"3": PAPER_TABLE_3, "4": PAPER_TABLE_4}[table].values()
            for place in [method if order is None else _place(figures, hard, order)]
            if place in figures
        ]
    return " | ".join(" ".join(f"{value:3d}" for value in line) for line in found) or "-"


def _place(figures: dict, hard: int, order: list[int] | str) -> int | None:
    """Where the hard object stands in an order; last is last, of however many."""
    if isinstance(order, str):
        return None
    place = order.index(hard + 1)
    last = max(key for key in figures if isinstance(key, int))
    return last if place == len(order) - 1 else place


def _with_interval(row: dict[str, Any], rate: str) -> str:
    low, high = (100 * end for end in row[f"{rate}_interval"])
    return f"{100 * row[rate]:3.0f} [{low:3.0f},{high:4.0f}]"


def _verdicts(name: str, checks: list[dict[str, Any]]) -> list[str]:
    failed = [check for check in checks if not check["holds"]]
    if not failed:
        return [f"{name}: comes out as in the paper" if checks else f"{name}: nothing to compare"]
    lines = [f"{name} does NOT come out as in the paper:"]
    for check in failed:
        where = "" if check["lambda"] is None else f"λ = {check['lambda']:g}: "
        lines.append(f"  {where}not so that {check['claim']} ({check['detail']})")
    return lines
