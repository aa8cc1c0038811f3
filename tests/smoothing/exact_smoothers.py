"""Smoothing distributions by numpy in double precision, written apart from the filters."""

import numpy as np


def gaussian_smoother(model, observations, inputs=None):
    """Mean (t + 1, d) and covariance ((t + 1) d, (t + 1) d) of x_0, ..., x_t given y.

    All states are one Gaussian vector, of which the observations are linear functions. A row of
    NaN is missing. `inputs` are u_t of B u_t, where there are any.
    """
    drifts = np.zeros((len(observations), 1)) if inputs is None else inputs @ np.asarray(model.B).T
    a, q, h, r, mean, covariance = (
        np.asarray(value, float)
        for value in (model.A, model.Q, model.H, model.R, model.m0, model.P0)
    )
    d, length = len(mean), len(observations)
    means = [mean]
    blocks = np.zeros((length + 1, d, length + 1, d))
    blocks[0, :, 0] = covariance
    for t in range(1, length + 1):
        means.append(a @ means[-1] + drifts[t - 1])
        for s in range(t):
            blocks[t, :, s] = a @ blocks[t - 1, :, s]
            blocks[s, :, t] = blocks[t, :, s].T
        blocks[t, :, t] = a @ blocks[t - 1, :, t - 1] @ a.T + q
    prior_mean = np.concatenate(means)
    prior = blocks.reshape((length + 1) * d, -1)
    seen = [t for t in range(length) if not np.isnan(observations[t]).any()]
    design = np.zeros((len(seen) * len(h), (length + 1) * d))
    for row, t in enumerate(seen):
        design[row * len(h) : (row + 1) * len(h), (t + 1) * d : (t + 2) * d] = h
    noise = np.kron(np.eye(len(seen)), r)
    gain = prior @ design.T @ np.linalg.inv(design @ prior @ design.T + noise)
    values = np.concatenate([np.asarray(observations[t], float) for t in seen])
    posterior = prior_mean + gain @ (values - design @ prior_mean)
    return posterior.reshape(-1, d), prior - gain @ design @ prior


def grid_smoother(log_initial, log_transition, log_likelihoods):
    """P(x_s = grid point | y) for s = 0, ..., t, and of the pairs (x_{s-1}, x_s).

    `log_transition[i, j]` is log D(j | i); `log_likelihoods` is (t, g).
    """
    kernel = np.exp(log_transition)
    likelihoods = np.exp(log_likelihoods)
    forward = [np.exp(log_initial) / np.exp(log_initial).sum()]
    for likelihood in likelihoods:
        joint = (forward[-1] @ kernel) * likelihood
        forward.append(joint / joint.sum())
    backward = [np.ones(len(log_initial))]
    for likelihood in likelihoods[::-1]:
        message = kernel @ (likelihood * backward[-1])
        backward.append(message / message.sum())
    backward = backward[::-1]
    smoothed = [f * b / (f @ b) for f, b in zip(forward, backward, strict=True)]
    pairs = []
    for s, likelihood in enumerate(likelihoods):
        joint = forward[s][:, None] * kernel * (likelihood * backward[s + 1])[None]
        pairs.append(joint / joint.sum())
    return np.array(smoothed), np.array(pairs)


def grid_trajectories(rng, num, points, smoothed, pairs):
    """Trajectories (num, t + 1) drawn from what `grid_smoother` found."""
    indices = [rng.choice(len(points), num, p=smoothed[0])]
    for pair in pairs:
        upto = np.cumsum(pair[indices[-1]], axis=1)
        quantiles = rng.random(num) * upto[:, -1]
        indices.append((upto <= quantiles[:, None]).sum(axis=1))
    return points[np.stack(indices, axis=1)].astype(np.float32)
