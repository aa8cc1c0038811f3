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
    """One line of a file of mpfjax as it is, as it is broken, and the tests that must fail."""

    file: str
    line: str
    broken: str
    tests: str


BUGS = {
    "an object that was missed stays as probable": Bug(
        "moves/objects/bernoulli.py",
        "masses = seen + unseen * before.of_owners(1 / rows, 1)",
        "masses = seen + unseen",
        "tests/moves/test_bernoulli.py -k sensors_in_turn",
    ),
    "the proposal's density has the wrong sign": Bug(
        "moves/propagation/propagate.py",
        "log_factors.append(log_transition(now.model, draws, previous) - log_density)",
        "log_factors.append(log_transition(now.model, draws, previous) + log_density)",
        "tests/test_exact_answers.py -k guided",
    ),
    "nested propagation sums over proposals": Bug(
        "moves/propagation/nested.py",
        "log_weights=repeated.log_weights - math.log(k)",
        "log_weights=repeated.log_weights",
        "tests/test_exact_answers.py -k proposals",
    ),
    "MALA forgets its step back": Bug(
        "moves/metropolis.py",
        "reverse = forth + drift(proposed) + noise",
        "reverse = forth + forth + noise",
        "tests/test_exact_answers.py -k Langevin",
    ),
    "densities are stale after an accepted step": Bug(
        "moves/metropolis.py",
        "states, densities = accepted(key_taken, log_ratio, new, old)",
        "states, _ = accepted(key_taken, log_ratio, new, old)",
        "tests/test_exact_answers.py -k RandomWalk",
    ),
    "prior masses of DPS count the dead": Bug(
        "moves/objects/partitioned.py",
        "log_total = log_sum_exp(jnp.where(alive, prior, -jnp.inf))",
        "log_total = log_sum_exp(prior)",
        "tests/test_exact_answers.py -k dps",
    ),
    "slots are dealt by variances, not by their roots": Bug(
        "moves/resampling/allocation.py",
        "demands = masses * jnp.sqrt(variances)",
        "demands = masses * variances",
        "tests/test_exact_answers.py -k slots",
    ),
    "PMMH accepts by the same number at every step": Bug(
        "tuning/walks.py",
        "jnp.log(jax.random.uniform(key_accept, (), gain.dtype)) < gain",
        "jnp.log(jax.random.uniform(jax.random.key(0), (), gain.dtype)) < gain",
        "tests/test_exact_answers.py -k chains",
    ),
    # running
    "islands forget each other's scale": Bug(
        "operations/islands.py",
        "log_total = log_sum_exp(sums + (((scales - common) + largest) - shift))",
        "log_total = log_sum_exp(sums)",
        "tests/test_devices.py -k unbiased",
    ),
    "threads run the first block again": Bug(
        "running/devices.py",
        "return run(_at(inputs, first + np.arange(size)), *arguments)",
        "return run(_at(inputs, np.arange(size)), *arguments)",
        "tests/test_devices.py -k one_block",
    ),
    "a study's batches share their keys": Bug(
        "running/studies.py",
        "batch = study.keys[np.clip(np.arange(start, start + size), 0, num_seeds - 1)]",
        "batch = study.keys[np.arange(size)]",
        "tests/test_studies.py -k those_of_monte_carlo",
    ),
    "a resumed study runs finished cells again": Bug(
        "running/studies.py",
        "pending = [cell for cell in cells if cell.file not in results]",
        "pending = cells",
        "tests/test_studies.py -k goes_on",
    ),
    "slots beyond N have weight": Bug(
        "running/run.py",
        "log_weights=jnp.where(slot < number, filled.log_weights, -jnp.inf),",
        "log_weights=filled.log_weights,",
        "tests/test_studies.py -k shared_slots",
    ),
    "a checkpoint counts one step too many": Bug(
        "running/long_runs.py",
        'notes = {"step": state.step, "identity": self.identity(state.step)}',
        'notes = {"step": state.step + 1, "identity": self.identity(state.step)}',
        "tests/test_storage.py -k LongRuns",
    ),
    "a file is renamed before it is written": Bug(
        "running/storage.py",
        'partial = path.with_name(f"{path.name}.{secrets.token_hex(8)}.partial")',
        "partial = path",
        "tests/test_storage.py -k TestFullDisk",
    ),
    # Filters, resampling and regrouping.
    "residual resampling draws from what is expected in all": Bug(
        "moves/resampling/ancestors.py",
        "dealt.line.positions(jnp.maximum(expected - whole, 0.0), left, rest.firsts)",
        "dealt.line.positions(expected, left, rest.firsts)",
        "tests/moves/test_contracts.py -k unbiased",
    ),
    "SSP keeps the wrong one of a pair": Bug(
        "moves/resampling/ancestors.py",
        "left_stays = draw < jnp.where(one_is_up, 1 - left, left)",
        "left_stays = draw < jnp.where(one_is_up, 1 - right, left)",
        "tests/moves/test_contracts.py -k unbiased",
    ),
    "the threshold of adaptive resampling is one of all particles": Bug(
        "moves/resampling/resample.py",
        "least = self.ess_threshold * counts.astype(mixture.log_weights.dtype)",
        "least = self.ess_threshold * jnp.sum(counts).astype(mixture.log_weights.dtype)",
        "tests/moves/test_contracts.py -k adaptive",
    ),
    "conditional SMC draws from the start of the kept interval": Bug(
        "moves/resampling/ancestors.py",
        "kept.point(dealt.before, dealt.kept.shares[0] * dealt.expected[dealt.kept.place])",
        "kept.point(dealt.before, 0 * dealt.expected[dealt.kept.place])",
        "tests/moves/test_conditional.py -k systematic",
    ),
    "a look-ahead is not divided out again": Bug(
        "moves/resampling/auxiliary.py",
        "drawn = drawn.weighed(-take(log_factors, ancestors.particles))",
        "drawn = drawn.weighed(0 * take(log_factors, ancestors.particles))",
        "tests/moves/test_auxiliary.py -k expected",
    ),
    "regeneration forgets the weights": Bug(
        "moves/resampling/gaussian.py",
        "weights = mixture.component_weights.astype(states.dtype)",
        "weights = mixture.occupied.astype(states.dtype)",
        "tests/moves/test_gaussian.py -k moments",
    ),
    "the share of a half is one of any mass": Bug(
        "moves/regrouping/split.py",
        "& (least_mass >= self.min_share * total)",
        "& (least_mass >= self.min_share)",
        "tests/moves/test_regrouping.py -k min_share",
    ),
    "Gauss-Newton's volume is inverted": Bug(
        "moves/propagation/proposals.py",
        "log_volume = -jnp.sum(jnp.log(jnp.diagonal(factors, axis1=1, axis2=2)), axis=1)",
        "log_volume = jnp.sum(jnp.log(jnp.diagonal(factors, axis1=1, axis2=2)), axis=1)",
        "tests/test_proposals.py -k normaliser",
    ),
    "a chosen x_0 is weighed by its chance": Bug(
        "moves/initial.py",
        "log_weights=jnp.where(filled, -jnp.log(trust * total), -jnp.inf),",
        "log_weights=jnp.where(filled, jnp.log(trust / jnp.sum(trust)), -jnp.inf),",
        "tests/test_initial.py -k represent",
    ),
    "an object among clutter is never missed": Bug(
        "models/clutter.py",
        "missed = (1 - p) * jnp.exp(-largest)",
        "missed = (0.95 - p) * jnp.exp(-largest)",
        "tests/models/test_clutter.py -k plain",
    ),
    # vision and metrics
    "histograms count half a pixel off": Bug(
        "vision/colour/histograms.py",
        "jnp.ceil(inside - 0.5).astype(jnp.int32)",
        "jnp.ceil(inside).astype(jnp.int32)",
        "tests/vision/test_histograms.py -k numpys",
    ),
    "OSPA's cutoff cuts at twice of it": Bug(
        "metrics/set_distances.py",
        "jnp.pad(jnp.minimum(distances, 1.0), (rows, columns))",
        "jnp.pad(jnp.minimum(distances, 2.0), (rows, columns))",
        "tests/metrics/test_set_distances.py -k ospa",
    ),
    "GOSPA counts a pair beyond the cutoff once for each": Bug(
        "metrics/set_distances.py",
        "shares = jnp.where(pairing.is_pair, 0.5, 1.0 / alpha)",
        "shares = jnp.where(pairing.is_pair, 1.0, 1.0 / alpha)",
        "tests/metrics/test_set_distances.py -k gospa",
    ),
    "the cost of a pair has no determinant": Bug(
        "vision/tracking/associate.py",
        "return tails + np.minimum(volumes, _WIDEST)[:, None]",
        "return tails",
        "tests/vision/test_association.py -k density",
    ),
    "objects end a frame too early": Bug(
        "vision/tracking/lives.py",
        "return lives, unseen <= most",
        "return lives, unseen < most",
        "tests/vision/test_tracker.py -k outlives",
    ),
    "no chain of weak scores is an object's": Bug(
        "vision/tracking/scores.py",
        "proved = seen & ((own >= _SURE) | (age >= lasting))",
        "proved = seen & (own >= _SURE)",
        "tests/vision/test_learning.py -k chains",
    ),
    "objects move against the camera": Bug(
        "vision/tracking/tracker.py",
        "objects = state.objects.shifted(shift)",
        "objects = state.objects.shifted(-shift)",
        "tests/vision/test_tracker.py -k shaking",
    ),
    "births do not know the frame rate": Bug(
        "vision/tracking/noise.py",
        "start = min(25 / frames_per_second, _MOST) * _SPEED",
        "start = 1.0 * _SPEED",
        "tests/vision/test_tracker.py -k rare",
    ),
    # Propagation, several objects, look-aheads.
    "tempered moves draw everything by one key": Bug(
        "moves/propagation/tempered.py",
        "key_step, key_noise, key_taken = split(key, 3)",
        "key_step, key_noise, key_taken = key, key, key",
        "tests/moves/test_tempered.py",
    ),
    "moments are not updated by what is seen": Bug(
        "moves/propagation/propagate.py",
        "states, log_factors = seen(now.model, now.observation, states)",
        "_, log_factors = seen(now.model, now.observation, states)",
        "tests/moves/test_marginalised.py -k kalman",
    ),
    "regimes follow each other by the transposed matrix": Bug(
        "models/linear.py",
        "(jnp.full_like(latent, j), spread(log_matrix[:, j], latent))",
        "(jnp.full_like(latent, j), spread(log_matrix[j], latent))",
        "tests/moves/test_marginalised.py -k kept_twice",
    ),
    "an object does not meet the one that moved just before": Bug(
        "moves/objects/partitioned.py",
        "has_moved = ranks < rank",
        "has_moved = ranks < rank - 1",
        "tests/moves/test_partitioned.py -k joint_state",
    ),
    "components move their objects in one order": Bug(
        "moves/objects/partitioned.py",
        "return take(objects, mixture.component_indicators)",
        "return objects[0]",
        "tests/moves/test_partitioned.py -k moved_last",
    ),
    "the cloud of a start decides its own powers": Bug(
        "moves/start/window.py",
        "log_mean += log_sum_exp(log_weights[:n]) - np.log(n)",
        "log_mean += log_sum_exp(log_weights) - np.log(number)",
        "tests/moves/start/test_window.py -k edges",
    ),
    "a start forgets p(x_0)": Bug(
        "moves/start/window.py",
        "return log_prior + paths.log_before + power * paths.log_last",
        "return 0 * log_prior + paths.log_before + power * paths.log_last",
        "tests/moves/start/test_window.py -k unbiased",
    ),
    "restarts forget the mass of their choice": Bug(
        "mixture.py",
        "log_share = (other.log_scale - log_scale) - math.log(num_islands())",
        "log_share = jnp.zeros_like(log_scale)",
        "tests/moves/test_restarts.py -k kernel",
    ),
    "a point set is not shifted": Bug(
        "models/noise.py",
        "points = sobol_points(ranks, directions) ^ shifts",
        "points = sobol_points(ranks, directions)",
        "tests/test_point_sets.py -k exactly_normal",
    ),
    "a twisted draw's density lacks its volume": Bug(
        "lookahead/quadratics.py",
        "return 0.5 * (norm - inner(residuals, residuals)) + log_volume",
        "return 0.5 * (norm - inner(residuals, residuals))",
        "tests/lookahead/test_learned.py",
    ),
    # smoothing
    "backward sampling forgets the next state": Bug(
        "smoothing/backward.py",
        "log_weights = mixture.log_weights + log_density(future)",
        "log_weights = mixture.log_weights + 0 * log_density(future)",
        "tests/smoothing/test_contracts.py -m 'not exactness' -k backward",
    ),
    "the smoother's inputs are one step off": Bug(
        "smoothing/trajectories.py",
        "steps = (keys, earlier, ancestors, starts_of(mixtures)[1:], proposed, inputs)",
        "inputs = jax.tree.map(lambda u: u[::-1], inputs)\n"
        "    steps = (keys, earlier, ancestors, starts_of(mixtures)[1:], proposed, inputs)",
        "tests/smoothing/test_contracts.py -m 'not exactness' -k backward",
    ),
    "PaRIS leaves sums where they were": Bug(
        "smoothing/sums.py",
        "return jax.vmap(of_past)(terms), _over_draws(Terms(values, no_spread), num_draws)",
        "return terms, _over_draws(Terms(values, no_spread), num_draws)",
        "tests/smoothing/test_contracts.py -m 'not exactness' -k PaRIS",
    ),
    "a fixed lag keeps the term that is overwritten": Bug(
        "smoothing/sums.py",
        "last = (t + 1) % num_kept",
        "last = t % num_kept",
        "tests/smoothing/test_contracts.py -k 'lag and MCMC and mpf and one'",
    ),
    "the variance of log Ẑ counts pairs for less": Bug(
        "moves/eve_indices.py",
        "grown = jnp.where(due & (k > 1), -jnp.log1p(-1 / jnp.maximum(k, 2)), 0.0)",
        "grown = jnp.where(due & (k > 1), jnp.log1p(-1 / jnp.maximum(k, 2)), 0.0)",
        "tests/smoothing/test_variance.py",
    ),
    "conditional SMC loses its reference": Bug(
        "moves/conditional.py",
        "jax.tree.map(lambda leaf, own: put(leaf, own, slot), mixture.particles, states)",
        "mixture.particles",
        "tests/smoothing/test_conditional.py -k 'many and components'",
    ),
    # tuning
    "SMC² does not normalise its weights": Bug(
        "tuning/parameter_particles.py",
        "samples = samples.replace(particles=points, log_weights=log_weights - total)",
        "samples = samples.replace(particles=points, log_weights=log_weights)",
        "tests/test_exact_answers.py -k smc2",
    ),
    "posteriors leave out the prior": Bug(
        "tuning/densities.py",
        "return self.log_prior + self.log_likelihood",
        "return self.log_likelihood",
        "tests/tuning/test_densities.py",
    ),
    "posteriors leave out the Jacobian": Bug(
        "tuning/densities.py",
        "density += self.transforms[name].log_jacobian(u)",
        "density += 0 * self.transforms[name].log_jacobian(u)",
        "tests/tuning/test_posteriors.py -k by_metropolis",
    ),
    "a Metropolis step is accepted by the walk's key": Bug(
        "tuning/walks.py",
        "jnp.log(jax.random.uniform(key_accept, (), gain.dtype)) < gain",
        "jnp.log(jax.random.uniform(key_walk, (), gain.dtype)) < gain",
        "tests/test_exact_answers.py -k chains",
    ),
    # Models, exact answers and inputs.
    "A of a linear model is transposed": Bug(
        "models/linear.py",
        "mean = states @ self.A.T",
        "mean = states @ self.A",
        "tests/models/test_models.py -k linear",
    ),
    "an autoregression forgets the volume of its noise": Bug(
        "models/dynamics.py",
        "return row_sums(log_normal(solve_lower(factors, steps), 1.0)) - log_volume",
        "return row_sums(log_normal(solve_lower(factors, steps), 1.0))",
        "tests/models/test_dynamics.py -k density",
    ),
    "a velocity learns twice what it should": Bug(
        "models/dynamics.py",
        "return following - (expected - current) - gain * (following - expected)",
        "return following - (expected - current) - 2 * gain * (following - expected)",
        "tests/models/test_dynamics.py -k path",
    ),
    "regimes follow each other backwards": Bug(
        "exact/switching.py",
        "log_prior = log_prior + model.log_transition(sequences[:, s + 1], sequences[:, s])",
        "log_prior = log_prior + model.log_transition(sequences[:, s], sequences[:, s + 1])",
        "tests/models/test_switching.py -k joint",
    ),
    "pairs of objects interact twice": Bug(
        "models/multi_object.py",
        "for of in np.triu_indices(self.num_objects, 1)",
        "for of in np.nonzero(~np.eye(self.num_objects, dtype=bool))",
        "tests/models/test_multi_object.py -k pairs",
    ),
    "the grid's kernel has no width of a cell": Bug(
        "exact/grid.py",
        "return cell * jnp.exp(jax.vmap(row)(states))",
        "return jnp.exp(jax.vmap(row)(states))",
        "tests/test_exact.py -k grid",
    ),
    "a grid's cell counts to one side of the threshold alone": Bug(
        "exact/grid.py",
        "jnp.clip((self.grid - threshold) / cell + 0.5, 0.0, 1.0)",
        "jnp.clip((self.grid - threshold) / cell, 0.0, 1.0)",
        "tests/test_exact.py -k modes",
    ),
    "the smoother goes back by the filter's covariance": Bug(
        "exact/kalman.py",
        "gain @ later_covariance @ gain.T",
        "gain @ law.moments[1] @ gain.T",
        "tests/test_exact.py -k joint",
    ),
    "a small noise is lost beside a diffuse prior": Bug(
        "exact/kalman.py",
        "remains = column(rest)",
        "remains = 0 * share",
        "tests/test_exact.py -k diffuse",
    ),
    "inputs of trajectories are one step off": Bug(
        "smoothing/trajectories.py",
        "steps = (keys, earlier, ancestors, starts_of(mixtures)[1:], proposed, inputs)",
        "off = jax.tree.map(lambda u: jnp.roll(u, 1), inputs)\n"
        "    steps = (keys, earlier, ancestors, starts_of(mixtures)[1:], proposed, off)",
        "tests/test_inputs.py -k smoothed",
    ),
    "a step of zero likelihood keeps no weights": Bug(
        "mixture.py",
        "log_weights = jnp.where(keep, shares, previous.log_weights)",
        "log_weights = shares",
        "tests/test_filters.py -k impossible",
    ),
    # operations
    "zeros at a block's end take a share of a sum": Bug(
        "operations/prefix_sums.py",
        "jnp.where(within == totals[:, None], upto, jnp.minimum",
        "jnp.where(within < 0, upto, jnp.minimum",
        "tests/test_operations.py -k never_fall",
    ),
    "sums in two parts do not carry a fraction of one": Bug(
        "operations/prefix_sums.py",
        "carried = (upto < words) | is_one",
        "carried = upto < words",
        "tests/test_operations.py -k two_parts",
    ),
    "a word of the generator is not added": Bug(
        "operations/random.py",
        "low = low + keys[(group + 2) % 3] + jnp.uint32(group + 1)",
        "low = low + keys[(group + 2) % 3] + jnp.uint32(group)",
        "tests/test_generator.py -k published",
    ),
    "entries of no segment count in the first": Bug(
        "operations/segments.py",
        "labels = jnp.where((segments >= 0) & (segments < num_segments), segments, num_segments)",
        "labels = jnp.clip(segments, 0, num_segments)",
        "tests/test_operations.py -k gradient",
    ),
    "weights become subnormal": Bug(
        "operations/logarithms.py",
        "smallest = math.log(info.tiny) - math.log(info.eps)",
        "smallest = math.log(info.tiny)",
        "tests/test_operations.py -k subnormal",
    ),
    "columns of no weight are drawn": Bug(
        "operations/matrices.py",
        "jnp.where(is_positive & (upto > target[:, None]), place, last + 1)",
        "jnp.where(upto >= target[:, None], place, last + 1)",
        "tests/test_operations.py -k quantile_is_drawn",
    ),
}


def survives(bug: Bug | None, tests: str) -> str:
    """An empty string where the tests fail on the bug, or what is wrong."""
    with tempfile.TemporaryDirectory() as folder:
        for name in COPIED:
            source, target = REPOSITORY / name, Path(folder) / name
            shutil.copytree(source, target) if source.is_dir() else shutil.copy(source, target)
        if bug is not None:
            file = Path(folder) / "mpfjax" / bug.file
            code = file.read_text(encoding="utf-8") if file.exists() else ""
            if code.count(bug.line) != 1:
                return f"{bug.file} holds its line {code.count(bug.line)} times"
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
