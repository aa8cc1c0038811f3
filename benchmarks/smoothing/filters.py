"""The jobs as models of mpfjax, and the filters that are smoothed."""

from collections.abc import Callable

import numpy as np

import mpfjax
from benchmarks.smoothing.jobs import Job, Linear


def make_model(job: Job, *, independent: bool = False) -> mpfjax.AbstractStateSpaceModel:
    """The model of a job; with `independent` draws of x_0 where it could be stratified."""
    if isinstance(job, Linear):
        rows = {"A": job.a, "Q": job.q**2, "H": 1.0, "R": job.r**2, "P0": job.p**2}
        matrices = {name: np.full((1, 1), value, np.float32) for name, value in rows.items()}
        return mpfjax.LinearGaussianModel(m0=np.zeros(1, np.float32), **matrices)
    draw = "independent" if independent else "stratified"
    return mpfjax.QuadraticModel(job.sigma_x, job.sigma_y, -job.width, job.width, draw)


def observations_of(job: Job) -> np.ndarray:
    """y_1..y_T as the model takes them."""
    seen = job.observations.astype(np.float32)
    return seen[:, None] if isinstance(job, Linear) else seen


def _auxiliary(model: mpfjax.AbstractStateSpaceModel, num_particles: int) -> mpfjax.Filter:
    proposal = mpfjax.GaussNewtonProposal(model)
    plain = mpfjax.mixture_particle_filter(model, num_particles, 2)
    return mpfjax.with_point_sets(mpfjax.with_lookahead(plain, proposal))


def _guided(model: mpfjax.AbstractStateSpaceModel, num_particles: int) -> mpfjax.Filter:
    proposal = mpfjax.GaussNewtonProposal(model)
    return mpfjax.mixture_particle_filter(model, num_particles, 2, proposal=proposal, noise="rqmc")


FILTERS: dict[str, Callable[[mpfjax.AbstractStateSpaceModel, int], mpfjax.Filter]] = {
    "PF": mpfjax.particle_filter,
    "multinomial PF": lambda model, num_particles: mpfjax.particle_filter(
        model, num_particles, scheme="multinomial"
    ),
    "MPF": lambda model, num_particles: mpfjax.mixture_particle_filter(model, num_particles, 2),
    "guided MPF": _guided,
    "auxiliary MPF": _auxiliary,
}
