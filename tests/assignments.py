"""Sums over all assignments of rows to columns, one by one."""

import itertools

import numpy as np


def enumerated(pairs, missed, alone):
    """The probability of each pair, and log of the sum over all assignments.

    A row without a column has the weight `missed`, a column without a row `alone`.
    """
    (m, k), total, shares = pairs.shape, 0.0, np.zeros(pairs.shape)
    for choice in itertools.product(range(-1, k), repeat=m):
        taken = [column for column in choice if column >= 0]
        if len(set(taken)) < len(taken):
            continue
        weight = np.prod([alone[j] for j in range(k) if j not in taken])
        weight *= np.prod([missed[i] if j < 0 else pairs[i, j] for i, j in enumerate(choice)])
        total += weight
        for row, column in enumerate(choice):
            if column >= 0:
                shares[row, column] += weight
    return shares / total, np.log(total)
