"""The paper's findings, each with whether it holds here and the figures that say so."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from benchmarks.partitioned_sampling.paper import PAPER_TABLE_1
from benchmarks.partitioned_sampling.rates import mean_with_interval

_NEAR = 0.05  # of the paper's precision
_PS_PRECISION = 0.90  # the paper's for PS and DPS at every λ, within a point
_MOST_OF_JOINT, _LEAST_GAP, _SHARE_OF_SCENES = 0.15, 0.10, 0.75
_FIRST_STAGE = 0.06  # of the uniqueness of PS


def checks_of(content: dict[str, Any]) -> list[dict[str, Any]]:
    """Every claim with `table`, `lambda`, `claim`, `holds` and `detail`."""
    makers = {"1": _table_1, "2": _table_2, "3": _table_3}
    found = []
    for table, means in content["means"].items():
        lambdas = list(dict.fromkeys(entry["lambda"] for entry in means))
        for lambda_ in lambdas:
            named = {_name(entry): entry for entry in means if entry["lambda"] == lambda_}
            for claim, holds, detail in makers[table](lambda_, named):
                found.append(_check(table, lambda_, claim, holds, detail))
        if table == "2":
            found += _dps_above_ps(content, lambdas)
        if table == "3":
            found += _differences(content)
    return [*found, *_impoverishment(content["uniqueness"])]


def _check(table: str, lambda_: float | None, claim: str, holds: Any, detail: str) -> dict:
    return {
        "table": table, "lambda": lambda_, "claim": claim, "holds": bool(holds), "detail": detail
    }  # fmt: skip


def _name(entry: dict[str, Any]) -> str:
    return entry["method"] if entry["order"] is None else f"PS {entry['order']}"


Claim = tuple[str, Any, str]


def _table_1(lambda_: float, named: dict[str, dict]) -> Iterator[Claim]:
    for name in ("PS mean", "dps"):
        if name in named:
            success, precision = named[name]["success"], named[name]["precision"]
            yield f"{name} has a success of 100%", success == 1, _percent(success)
            claim = f"{name} has a precision within 5 points of the paper's 90"
            yield claim, abs(precision - _PS_PRECISION) <= _NEAR, _percent(precision)
    if "joint" in named:
        success, precision = named["joint"]["success"], named["joint"]["precision"]
        yield "joint has a success of 90% or more", success >= 0.9, _percent(success)
        paper = PAPER_TABLE_1.get(round(lambda_), {}).get("joint")
        if paper:
            claim = f"joint has a precision within 5 points of the paper's {paper[1]}"
            yield claim, abs(precision - paper[1] / 100) <= _NEAR, _percent(precision)


def _table_2(lambda_: float, named: dict[str, dict]) -> Iterator[Claim]:
    if "joint" in named:
        joint = named["joint"]["recovery"]
        yield "joint has a recovery of 15% or less", joint <= _MOST_OF_JOINT, _percent(joint)
    if {"joint", "PS mean", "dps"} <= set(named):
        recovery = [named[name]["recovery"] for name in ("joint", "PS mean", "dps")]
        detail = " < ".join(map(_percent, recovery))
        yield "recovery rises from joint over PS to DPS", all(np.diff(recovery) > 0), detail


def _table_3(lambda_: float, named: dict[str, dict]) -> Iterator[Claim]:
    for other in ("PS mean", "PS worst", "joint"):
        if {"dps", other} <= set(named):
            high, low = named["dps"]["recovery"], named[other]["recovery"]
            detail = f"{_percent(high)} against {_percent(low)}"
            yield f"dps has a higher recovery than {other}", high > low, detail


def recoveries(content: dict[str, Any], table: str, name: str) -> dict[Any, float]:
    """Each scene's recovery by one filter, the mean over λ."""
    found: dict[Any, list[float]] = {}
    for entry in content["tables"][table] + content["summary"][table]:
        if not isinstance(entry["order"], list) and _name(entry) == name:
            found.setdefault(entry["scene"], []).append(entry["recovery"])
    return {scene: float(np.mean(values)) for scene, values in found.items()}


def _dps_above_ps(content: dict[str, Any], lambdas: list[float]) -> Iterator[dict]:
    ps, dps = (recoveries(content, "2", name) for name in ("PS mean", "dps"))
    gaps = [dps[scene] - ps[scene] for scene in ps if scene in dps]
    if not gaps:
        return
    mean, above = float(np.mean(gaps)), int(sum(gap > 0 for gap in gaps))
    claim = "dps recovers by 10 points or more above PS in the mean over λ"
    yield _check("2", None, claim, mean >= _LEAST_GAP, f"{100 * mean:.1f} points")
    claim = "dps recovers above PS in three quarters of the scenes or more"
    detail = f"{above} of {len(gaps)}"
    yield _check("2", None, claim, above >= _SHARE_OF_SCENES * len(gaps), detail)


def _differences(content: dict[str, Any]) -> Iterator[dict]:
    """The paper's order of filters on real frames as differences within events."""
    dps = recoveries(content, "3", "dps")
    for name in ("PS mean", "joint"):
        other = recoveries(content, "3", name)
        gaps = [dps[scene] - other[scene] for scene in other if scene in dps]
        if len(gaps) > 1:
            mean, _, (low, high) = mean_with_interval(gaps)
            detail = f"{100 * mean:.0f} points [{100 * low:.0f}, {100 * high:.0f}] over events"
            claim = f"dps recovers clearly more often than {name}"
            yield _check("3", None, claim, low > 0, detail)


def _impoverishment(uniqueness: dict[str, list[float]]) -> Iterator[dict]:
    firsts = []
    for name, shares in uniqueness.items():
        method, _, order = name.partition(" ")
        detail = ", ".join(f"{100 * share:.0f}" for share in shares)
        if order:
            stages = [shares[int(j) - 1] for j in order.split(",")]
            firsts.append(stages[0])
            claim = f"uniqueness falls towards the first stage under {name}"
            yield _check("figure 4", None, claim, all(np.diff(stages) > 0), detail)
        elif method.startswith("dps"):
            claim = f"no object has less than half of another's uniqueness under {name}"
            yield _check("figure 4", None, claim, min(shares) >= max(shares) / 2, detail)
    if firsts:
        mean = float(np.mean(firsts))
        claim = "the first stage of PS has a uniqueness of 6% or less, mean of the orders"
        yield _check("figure 4", None, claim, mean <= _FIRST_STAGE, f"{100 * mean:.1f}")


def _percent(share: float) -> str:
    return f"{100 * share:.1f}"
