"""The examples are exact: their estimates of the marginal likelihood are unbiased."""

import pytest

from examples import langevin, tempered_propagation


@pytest.mark.parametrize("example", [langevin, tempered_propagation])
def test_the_marginal_likelihood_is_unbiased(example):
    mean, error = example.main()
    assert abs(mean - 1) < 4 * error < 0.4
