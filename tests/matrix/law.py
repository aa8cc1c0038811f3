"""The law of the matrix and its exact answers, in numpy float64 and without the library.

x_0 ~ N(m0, p0²), x_t = a x_{t-1} + b u_t + N(0, q²), y_t = c + x_t + N(0, r²), log L shifted. A
chain of five states that are whole numbers has the same observations, and is summed over.
"""

from typing import Any, NamedTuple

import numpy as np


class Law(NamedTuple):
    """Its numbers; a pytree, so that a model of it may be differentiated in them."""

    a: Any = 0.9
    b: Any = 0.5
    q: Any = 0.6
    c: Any = 0.0
    r: Any = 0.5
    m0: Any = 0.5
    p0: Any = 1.0
    shift: Any = 0.0

    def in_units(self, unit):
        """The same law of a state and of observations that are so many times as large."""
        lengths = {name: unit * getattr(self, name) for name in ("b", "q", "c", "r", "m0", "p0")}
        return self._replace(**lengths)


class Answer(NamedTuple):
    """What is exact: log Z of each step, and moments of x_0, ..., x_t."""

    increments: np.ndarray
    means: np.ndarray
    """E[x_s | y_1..y_s], (t + 1,)."""
    variances: np.ndarray
    smoothed: np.ndarray
    """E[x_s | y_1..y_t], (t + 1,)."""
    pairs: np.ndarray
    """E[x_{s-1} x_s | y_1..y_t], (t,)."""
    ahead: tuple[float, float]
    """the mean and the variance of x_{t+1}, with u_{t+1} = 1 where there are inputs."""

    @property
    def log_z(self):
        return float(self.increments.sum())


def kalman(law, y, u):
    """The answer for observations of which NaN are missing."""
    a, b, q, c, r, m, p0, shift = map(float, law)
    p, increments, filtered, predicted = p0**2, [], [(m, p0**2)], []
    for y_t, u_t in np.array([y, u], float).T:
        m, p = a * m + b * u_t, a**2 * p + q**2
        predicted.append((m, p))
        increment = 0.0
        if not np.isnan(y_t):
            s, gap = p + r**2, y_t - c - m
            increment = shift - 0.5 * (np.log(2 * np.pi * s) + gap**2 / s)
            m, p = m + p / s * gap, p * r**2 / s
        increments.append(increment)
        filtered.append((m, p))
    smoothed, spread, pairs = [m], p, []
    for (m_s, p_s), (m_p, p_p) in zip(filtered[-2::-1], predicted[::-1], strict=True):
        gain, later = a * p_s / p_p, smoothed[-1]
        smoothed.append(m_s + gain * (later - m_p))
        pairs.append(smoothed[-1] * later + gain * spread)
        spread = p_s + gain**2 * (spread - p_p)
    backward = np.array(smoothed[::-1]), np.array(pairs[::-1])
    ahead = a * m + b * float(np.any(u)), a**2 * p + q**2
    return Answer(np.array(increments), *np.array(filtered).T, *backward, ahead)


def score(law, y, u, name, answer=kalman):
    """The derivative of log Z in one of the law's numbers."""
    value, step = float(getattr(law, name)), 1e-5
    above, below = (
        answer(law._replace(**{name: value + sign * step}), y, u).log_z for sign in (1, -1)
    )
    return (above - below) / (2 * step)


def posterior(law, y, u, name="c", answer=kalman, prior=(0.0, 1.0)):
    """Mean and variance of one of the law's numbers under a normal prior of such moments."""
    grid = np.linspace(-6.0, 6.0, 2401)
    logs = np.array([answer(law._replace(**{name: x}), y, u).log_z for x in grid])
    logs -= 0.5 * ((grid - prior[0]) / prior[1]) ** 2
    shares = np.exp(logs - max(logs))
    shares /= shares.sum()
    mean = shares @ grid
    return mean, shares @ (grid - mean) ** 2


STAY = 0.6


def chain_matrix():
    """The five states' transition probabilities: to stay, or to a neighbour."""
    matrix = STAY * np.eye(5)
    for k in range(5):
        for neighbour in (max(k - 1, 0), min(k + 1, 4)):
            matrix[k, neighbour] += (1 - STAY) / 2
    return matrix


def enumerated(law, y, u):
    """The answer of the chain, whose first state is any of the five."""
    del u
    states, matrix = np.arange(5.0), chain_matrix()
    share, increments, rows = np.full(5, 0.2), [], []
    rows.append(share)
    for y_t in y:
        share = share @ matrix
        increment = 0.0
        if not np.isnan(y_t):
            z = (y_t - law.c - states) / law.r
            likelihood = np.exp(-0.5 * z**2) / (law.r * np.sqrt(2 * np.pi))
            increment = float(np.log(share @ likelihood)) + law.shift
            share = share * likelihood / (share @ likelihood)
        increments.append(increment)
        rows.append(share)
    smoothed, pairs = [share], []
    for before in rows[-2::-1]:
        joint = before[:, None] * matrix
        joint *= smoothed[-1] / joint.sum(axis=0)
        smoothed.append(joint.sum(axis=1))
        pairs.append(states @ joint @ states)
    backward = np.array(smoothed[::-1]) @ states, np.array(pairs[::-1])
    means = np.array(rows) @ states
    variances = np.array(rows) @ states**2 - means**2
    last = share @ matrix
    ahead = last @ states, last @ states**2 - (last @ states) ** 2
    return Answer(np.array(increments), means, variances, *backward, ahead)
