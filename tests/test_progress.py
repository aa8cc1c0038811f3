"""Bars over compiled runs: they count every step once, and change nothing."""

import re

import jax
import numpy as np
import pytest

import mpfjax
from tests.marking import thorough
from tests.user_models import TrickyQuadraticModel, nothing_traced

FILTER = mpfjax.particle_filter(TrickyQuadraticModel(0.3, 0.5, -2.0, 2.0), 8)
SEEN = np.linspace(0.5, 2.0, 130, dtype=np.float32)
KEY = jax.random.key(0)


def nothing(mixture):
    return None


def last_count(captured):
    return re.findall(r"(\d+)/(\d+)", captured.err)[-1]


def test_a_run_is_the_same_with_a_bar_that_ends_at_its_last_step(capsys):
    plain = mpfjax.run_filter(KEY, FILTER, SEEN, nothing)
    assert capsys.readouterr().err == ""
    shown = mpfjax.run_filter(KEY, FILTER, SEEN, nothing, progress=True)
    assert last_count(capsys.readouterr()) == ("130", "130")
    np.testing.assert_allclose(
        shown.log_likelihood_increments, plain.log_likelihood_increments, rtol=1e-4, atol=1e-5
    )
    with nothing_traced():  # one program for all bars
        mpfjax.run_filter(KEY, FILTER, SEEN, nothing, progress=True)
    assert last_count(capsys.readouterr()) == ("130", "130")


@pytest.mark.parametrize("num_particles", [8, *thorough([1000])])
def test_many_runs_count_together(capsys, num_particles):
    """Under one vmap, and shared by threads."""
    filter = mpfjax.particle_filter(FILTER.model, num_particles)
    keys = jax.random.split(KEY, 4)
    plain = mpfjax.monte_carlo(keys, filter, SEEN[:11], nothing)
    shown = mpfjax.monte_carlo(keys, filter, SEEN[:11], nothing, progress=True)
    assert last_count(capsys.readouterr()) == ("44", "44")
    found, expected = (run.log_marginal_likelihood for run in (shown, plain))
    np.testing.assert_allclose(found, expected, rtol=1e-4)


def test_within_the_callers_program_there_is_no_bar(capsys):
    jax.jit(lambda key: mpfjax.run_filter(key, FILTER, SEEN, nothing, progress=True))(KEY)
    assert capsys.readouterr().err == ""


@pytest.mark.usefixtures("as_installed")
def test_what_is_no_flag_is_refused():
    with pytest.raises(ValueError, match="progress: 1 is neither True nor False"):
        mpfjax.run_filter(KEY, FILTER, SEEN, nothing, progress=1)
    with pytest.raises(ValueError, match="progress: None"):
        mpfjax.monte_carlo(KEY[None], FILTER, SEEN, nothing, progress=None)
