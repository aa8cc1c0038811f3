"""Puts bugs into a copy of the code, one at a time: a test must fail on each.

    python -m tests.bugs [NAME ...] [--jobs N]

copies the checkout for each bug of `BUGS`, or for the named ones, changes one line, and runs the
tests that must notice. It prints what noticed, and fails where a bug survives, or where its line
is no longer there. The tests are run on the unchanged code first.
"""

import argparse
import shlex
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

REPOSITORY = Path(__file__).resolve().parents[1]
COPIED = ("mpfjax", "tests", "benchmarks", "pyproject.toml")


class Bug(NamedTuple):
    """A line that stands once in mpfjax, the same line broken, and the tests that must fail."""

    line: str
    broken: str
    tests: str


BUGS = {
    "an object that was missed stays as probable": Bug(
        "+ unseen * before.of_owners(1 / rows, 1)",
        "+ unseen",
        "tests/moves/test_bernoulli.py -k sensors_in_turn",
    ),
    "the proposal's density has the wrong sign": Bug(
        "[now.law.log_transition(draws, previous) - log_density]",
        "[now.law.log_transition(draws, previous) + log_density]",
        "tests/together/test_exact_answers.py -k guided",
    ),
    "Metropolis moves forget where they are": Bug(
        "target.ratio(target(proposed), first)",
        "target.ratio(target(proposed), target(target.parents))",
        "tests/together/test_exact_answers.py -k metropolis",
    ),
    "prior masses of DPS count the dead": Bug(
        "log_total = log_sum_exp(jnp.where(alive, prior, -jnp.inf))",
        "log_total = log_sum_exp(prior)",
        "tests/together/test_exact_answers.py -k dps",
    ),
    "slots are dealt by variances, not by their roots": Bug(
        "demands = masses * jnp.sqrt(variances)",
        "demands = masses * variances",
        "tests/together/test_exact_answers.py -k slots",
    ),
    "PMMH accepts by the same number at every step": Bug(
        "jnp.log(jax.random.uniform(key_accept, (), gain.dtype)) < gain",
        "jnp.log(jax.random.uniform(jax.random.key(0), (), gain.dtype)) < gain",
        "tests/together/test_exact_answers.py -k chains",
    ),
    # running
    "islands forget each other's scale": Bug(
        "log_total = log_sum_exp(sums + (((scales - common) + largest) - shift))",
        "log_total = log_sum_exp(sums)",
        "tests/matrix/test_matrix.py -k particle-islands",
    ),
    "a resumed study runs finished cells again": Bug(
        "pending = [cell for cell in cells if cell.file not in results]",
        "pending = cells",
        "tests/running/test_studies.py -k goes_on",
    ),
    "a checkpoint counts one step too many": Bug(
        'notes = {"step": state.step, "identity": self._identity(state.step)}',
        'notes = {"step": state.step + 1, "identity": self._identity(state.step)}',
        "tests/running/test_storage.py -k LongRuns",
    ),
    # Filters, resampling and regrouping.
    "points of stratified resampling lie in half of their slots": Bug(
        "comes_before = take(shift, slot) < dealt.before.fraction",
        "comes_before = take(shift, slot) < 0.5 * dealt.before.fraction",
        "tests/moves/test_contracts.py -k unbiased",
    ),
    "a look-ahead is not divided out again": Bug(
        "result = result.reweight(-take(log_factors, ancestors.particles))",
        "result = result.reweight(0 * take(log_factors, ancestors.particles))",
        "tests/moves/test_auxiliary.py -k expected",
    ),
    "Gauss-Newton's volume is inverted": Bug(
        "0.5 * means.shape[1] * math.log(2 * math.pi) - _log_diagonal(factors)",
        "0.5 * means.shape[1] * math.log(2 * math.pi) + _log_diagonal(factors)",
        "tests/moves/test_proposals.py -k normaliser",
    ),
    "an object among clutter is never missed": Bug(
        "missed = (1 - p) * jnp.exp(-largest)",
        "missed = (0.95 - p) * jnp.exp(-largest)",
        "tests/models/test_clutter.py -k plain",
    ),
    # vision and metrics
    "OSPA's cutoff cuts at twice of it": Bug(
        "np.minimum(cdist(estimates, truths) / cutoff, 1.0)",
        "np.minimum(cdist(estimates, truths) / cutoff, 2.0)",
        "tests/metrics/test_set_distances.py -k ospa",
    ),
    "objects move against the camera": Bug(
        "objects = state.objects.shift(shift, faster)",
        "objects = state.objects.shift(-shift, faster)",
        "tests/vision/test_tracker.py -k shaking",
    ),
    # Propagation, several objects, look-aheads.
    "a start forgets p(x_0)": Bug(
        "log_prior = log_prior.astype(default_float())",
        "log_prior = 0 * log_prior.astype(default_float())",
        "tests/moves/start/test_restart.py -k beyond",
    ),
    "restarts forget the evidence of the old hypotheses": Bug(
        "log_odds = jnp.sum(increments - replaced)",
        "log_odds = jnp.sum(increments)",
        "tests/moves/start/test_restart.py -k evidence_and",
    ),
    "a twisted draw's density lacks its volume": Bug(
        "return 0.5 * (norm - inner(residuals, residuals)) + log_volume",
        "return 0.5 * (norm - inner(residuals, residuals))",
        "tests/lookahead/test_learned.py",
    ),
    # smoothing
    "backward sampling forgets the next state": Bug(
        "log_weights = mixture.log_weights + log_density(future)",
        "log_weights = mixture.log_weights + 0 * log_density(future)",
        "tests/matrix/test_matrix.py -k particle-trajectories",
    ),
    "the variance of log Ẑ counts pairs for less": Bug(
        "grown = jnp.where(due & (k > 1), -jnp.log1p(-1 / jnp.maximum(k, 2)), 0.0)",
        "grown = jnp.where(due & (k > 1), jnp.log1p(-1 / jnp.maximum(k, 2)), 0.0)",
        "tests/smoothing/test_variance.py",
    ),
    # tuning
    "posteriors leave out the Jacobian": Bug(
        "volumes = (self.transforms[name].log_jacobian(u) for name, u in reals.items())",
        "volumes = (0 * self.transforms[name].log_jacobian(u) for name, u in reals.items())",
        "tests/tuning/test_metropolis.py -k log_density",
    ),
    # Models, exact answers and inputs.
    "the smoother goes back by the filter's covariance": Bug(
        "gain @ later_covariance @ gain.T",
        "gain @ law.moments[1] @ gain.T",
        "tests/exact/test_exact.py -k joint",
    ),
    # operations
}


def file_with(line: str, package: Path) -> Path | None:
    """The file of the package that holds the line, unless it stands elsewhere too."""
    counts = {file: file.read_text(encoding="utf-8").count(line) for file in package.rglob("*.py")}
    return max(counts, key=counts.__getitem__) if sum(counts.values()) == 1 else None


def survives(bug: Bug | None, tests: str) -> str:
    """An empty string where the tests fail on the bug, or what is wrong."""
    with tempfile.TemporaryDirectory() as folder:
        for name in COPIED:
            source, target = REPOSITORY / name, Path(folder) / name
            shutil.copytree(source, target) if source.is_dir() else shutil.copy(source, target)
        if bug is not None:
            file = file_with(bug.line, Path(folder) / "mpfjax")
            if file is None:
                return "its line does not stand exactly once"
            code = file.read_text(encoding="utf-8")
            file.write_text(code.replace(bug.line, bug.broken), encoding="utf-8")
        command = [sys.executable, "-m", "pytest", "-q", "-x", "-n", "0", "-m", "", "-p"]
        run = subprocess.run(
            [*command, "no:cacheprovider", *shlex.split(tests)], cwd=folder, capture_output=True,
            text=True,
        )  # fmt: skip
    if bug is None:
        return "" if run.returncode == 0 else f"tests fail without a bug:\n{run.stdout[-2000:]}"
    # 1 is a failed test; any other status is a broken run.
    if run.returncode not in (0, 1):
        return f"the tests could not run:\n{run.stdout[-2000:]}"
    return "" if run.returncode == 1 else "SURVIVES"


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.bugs")
    parser.add_argument("names", nargs="*", metavar="NAME", help="part of a bug's name; all")
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args()
    wanted = options.names or [""]
    bugs = {name: bug for name, bug in BUGS.items() if any(part in name for part in wanted)}
    tests = sorted({bug.tests for bug in bugs.values()})
    with ThreadPoolExecutor(options.jobs) as pool:
        cases = [(f"no bug: {test}", pool.submit(survives, None, test)) for test in tests]
        cases += [(name, pool.submit(survives, bug, bug.tests)) for name, bug in bugs.items()]
        found = {name: future.result() for name, future in cases}
    for name, what in found.items():
        print(f"{what or 'as it should be':<16} {name}")
    return int(any(found.values()))


if __name__ == "__main__":
    sys.exit(main())
