"""What Smith and Gatica-Perez (2004) print in tables 1 to 4, in per cent."""

from typing import Any

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
PAPER_TABLE_3 = {
    "RealSeq1": {
        "joint": (32, 78, 59, 98), "first": (18, 18, 60, 98), "last": (40, 96, 58, 98),
        "dps": (100, 100, 62, 100),
    },
    "RealSeq2": {
        "joint": (10, 32, 72, 86), "first": (0, 8, 55, 91), "last": (12, 40, 72, 86),
        "dps": (78, 88, 58, 98),
    },
    "RealSeq3": {
        "joint": (4, 8, 41, 70), "first": (70, 72, 51, 86), "last": (26, 28, 46, 77),
        "dps": (36, 38, 51, 79),
    },
}  # fmt: skip
HEADERS = {
    "1": "suc pre rcl",
    "2": "rcv pre rcl",
    "3": "suc rcv pre rcl, RealSeq1 | 2 | 3",
}


def paper_of(table: str, row: dict[str, Any]) -> str:
    """What the paper has in the place of a row of means, or a dash."""
    name = row["method"] if row["order"] is None else row["order"]
    if table == "3":
        found = [figures[name] for figures in PAPER_TABLE_3.values() if name in figures]
    else:
        figures = {"1": PAPER_TABLE_1, "2": PAPER_TABLE_2}[table].get(round(row["lambda"]), {})
        found = [figures[name]] if name in figures else []
    return " | ".join(" ".join(f"{value:3d}" for value in line) for line in found) or "-"
