"""Values of some pairs of rows and columns: of many objects and detections, few are near."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

# A value for each of m objects.
Numbers = Float[np.ndarray, " m"]
Integers = Int[np.ndarray, " m"]
Flags = Bool[np.ndarray, " m"]


class Pairs(NamedTuple):
    """The possible pairs of m rows and d columns, each with a value.

    - `rows`, `columns`, `values`: (p,); `shape`: (m, d).
    """

    rows: Int[np.ndarray, " p"]
    columns: Int[np.ndarray, " p"]
    values: Float[np.ndarray, " p"]
    shape: tuple[int, int]

    @classmethod
    def of(cls, values: Float[np.ndarray, "m d"], possible: Bool[np.ndarray, "m d"]) -> "Pairs":
        """The pairs of a matrix where `possible` is true."""
        rows, columns = np.nonzero(possible)
        return cls(rows, columns, values[rows, columns], (values.shape[0], values.shape[1]))

    def at(self, which: Bool[np.ndarray, " p"]) -> "Pairs":
        """Some of the pairs."""
        return Pairs(self.rows[which], self.columns[which], self.values[which], self.shape)

    @property
    def rivals(self) -> Bool[np.ndarray, " p"]:
        """Which have another pair in their row or column."""
        m, d = self.shape
        others = np.bincount(self.rows, minlength=m)[self.rows] > 1
        return others | (np.bincount(self.columns, minlength=d)[self.columns] > 1)

    @property
    def partners(self) -> Int[np.ndarray, " m"]:
        """The column of each row where the two are each other's largest value above 0, else -1."""
        order = np.argsort(self.values, kind="stable")
        order = order[np.searchsorted(self.values[order], 0.0, side="right") :]
        rows, columns = self.rows[order], self.columns[order]
        # Of what is written to one place the last stays, which is the largest.
        first, second = np.full(self.shape[0], -1), np.full(self.shape[1], -1)
        first[rows], second[columns] = columns, rows
        mutual = np.append(second, -1)[first] == np.arange(len(first))
        return np.where(mutual, first, -1)

    def block(
        self, none: float
    ) -> tuple[Float[np.ndarray, "r c"], Int[np.ndarray, " p"], Int[np.ndarray, " p"]]:
        """The matrix of the rows and columns that have a pair, and where in it each pair is."""
        (names, rows), (others, columns) = (
            np.unique(each, return_inverse=True) for each in (self.rows, self.columns)
        )
        values = np.full((len(names), len(others)), none)
        values[rows, columns] = self.values
        return values, rows, columns


def intervals(
    low: Float[np.ndarray, " m"], high: Float[np.ndarray, " m"], points: Float[np.ndarray, " d"]
) -> tuple[Int[np.ndarray, " p"], Int[np.ndarray, " p"]]:
    """The pairs of intervals and the points within them: their rows and columns."""
    order = np.argsort(points, kind="stable")
    first = np.searchsorted(points[order], low)
    counts = np.maximum(np.searchsorted(points[order], high, side="right") - first, 0)
    rows = np.repeat(np.arange(len(low)), counts)
    columns = order[np.arange(len(rows)) + np.repeat(first - np.cumsum(counts) + counts, counts)]
    return rows, columns
