"""One optimisation: steps up the gradient until they are done, converged, or not finite."""

import os
import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Key, PyTree
from tqdm import tqdm

from mpfjax.checks import check_finite, check_flag, check_whole, given
from mpfjax.running.storage.checkpoints import Checkpoint, Notes, check_checkpoint, identity_of
from mpfjax.tuning.problem import Problem, Reals, scores


@dataclass(frozen=True)
class State:
    """The state of an optimisation: all that a checkpoint holds."""

    step: int
    reals: Reals
    optimizer: PyTree
    values: tuple[float, ...] = ()
    deviations: tuple[float, ...] = ()
    path: tuple[Reals, ...] = ()
    fault: str | None = None
    """what was not finite; no further step can repair it."""


@dataclass(frozen=True)
class End:
    """The end of an optimisation: its state, the objective there, and why it ended early."""

    state: State
    value: float
    stopped: str | None


@dataclass(frozen=True)
class Plan:
    """The number of steps, and what to keep: the arguments that `fit` and `maximise` share."""

    num_steps: int
    common_random_numbers: bool
    patience: int | None
    tolerance: float
    checkpoint: str | os.PathLike[str] | None
    checkpoint_every: int
    checkpoint_name: str | None
    progress: bool

    def __post_init__(self) -> None:
        check_whole(1, num_steps=self.num_steps)
        check_whole(1, **given(patience=self.patience))
        check_finite(tolerance=self.tolerance)
        check_flag(common_random_numbers=self.common_random_numbers, progress=self.progress)
        check_checkpoint(self.checkpoint, self.checkpoint_every, self.checkpoint_name)

    def converged(self, values: tuple[float, ...]) -> str | None:
        """Why the optimisation ends after these values, or None."""
        patience = self.patience
        if patience is None or len(values) < 2 * patience:
            return None
        before = np.mean(values[-2 * patience : -patience])
        gain = float(np.mean(values[-patience:]) - before)
        if gain > self.tolerance:
            return None
        return (
            f"{patience} steps gained {gain:.3g} nats, no more than the tolerance, {self.tolerance}"
        )


@dataclass(frozen=True)
class Optimisation:
    """The steps of one maximisation, for the public function `caller`.

    `settings` and `code` are those of the objective, as `identity_of` takes them.
    """

    caller: str
    objective: str
    key: Key[Array, ""]
    problem: Problem
    optimizer: optax.GradientTransformation
    num_seeds: int
    settings: dict[str, Any]
    code: dict[str, Any]
    plan: Plan

    @property
    def named(self) -> str:
        """The objective in words."""
        return self.objective.replace("_", " ")

    def run(self) -> End:
        """All steps, from the start or from the step of the checkpoint."""
        plan, state, file = self.plan, self.start(), None
        if plan.checkpoint is not None:
            # Before the first step, at which an optimiser may change what its closures hold.
            identity = self.identity(plan.checkpoint_name)
            file = Checkpoint(Path(plan.checkpoint), self.caller, lambda step: identity)
            state = self.saved(file, state)
        if state.fault is not None:
            self.warn(state.fault, stacklevel=4)
        saved = state
        # An optimisation from the file of one that has ended ends at once, by the same values.
        stopped = state.fault or plan.converged(state.values)
        bar = tqdm(total=plan.num_steps, initial=state.step, disable=not plan.progress, unit="step")
        try:
            while state.step < plan.num_steps and stopped is None:
                state = self.advance(state)
                stopped = state.fault
                if stopped is None:
                    bar.update()
                    bar.set_postfix({self.objective: f"{state.values[-1]:.2f}"}, refresh=False)
                    stopped = plan.converged(state.values)
                if file is not None and state.step % plan.checkpoint_every == 0:
                    self.save(file, state, stopped)
                    saved = state
            state, value = self.finish(state)
        finally:
            bar.close()
            if file is not None and state.step > 0 and state is not saved:
                self.save(file, state, state.fault or stopped)
        return End(state, value, state.fault or stopped)

    def history(self, state: State) -> dict[str, np.ndarray]:
        """The steps so far, parameters on their own scale."""
        points = [self.problem.constrained(reals) for reals in state.path]
        return {
            self.objective: np.array(state.values),
            "deviation": np.array(state.deviations),
        } | {name: np.array([point[name] for point in points]) for name in state.reals}

    def start(self) -> State:
        reals = self.problem.start()
        return State(0, reals, self.optimizer.init(reals))

    def batches(self, key: Key[Array, ""], num_seeds: int) -> list[Key[Array, " seeds"]]:
        """At least this number of seeds, in batches of a shape that is compiled already."""
        num_batches = -(-num_seeds // self.num_seeds)
        return list(jax.random.split(key, (num_batches, self.num_seeds)))

    def evaluate(self, state: State) -> tuple[np.ndarray, Reals, str | None]:
        """The objective of each seed, the gradient of their mean, and the fault, if any."""
        step = 0 if self.plan.common_random_numbers else state.step
        keys = jax.random.split(jax.random.fold_in(self.key, step), self.num_seeds)
        values, gradient = scores(self.problem, state.reals, keys)
        values = np.asarray(values)
        broken = [name for name, leaf in gradient.items() if not np.isfinite(leaf).all()]
        if not np.isfinite(values).all():
            return values, gradient, f"the {self.named} was {values.mean()}"
        if broken:
            return values, gradient, f"the gradient of {', '.join(broken)} was not finite"
        return values, gradient, None

    def advance(self, state: State) -> State:
        """One step up; or, with the fault, the state before the step that led here."""
        values, gradient, fault = self.evaluate(state)
        if fault is not None:
            return self.back(state, fault)
        idle = [name for name, leaf in gradient.items() if not np.asarray(leaf).any()]
        if state.step == 0 and idle:
            raise ValueError(
                f"parameters: the {self.named} does not depend on {', '.join(idle)};"
                " with gradient='stop' no filter's ever does on a proposal's"
            )
        descent = jax.tree.map(jnp.negative, gradient)
        # Optimisers need JAX's default promotion, whatever the caller has set.
        with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
            updates, optimizer = self.optimizer.update(descent, state.optimizer, state.reals)
            reals: Any = optax.apply_updates(state.reals, updates)
        return State(
            step=state.step + 1,
            reals=reals,
            optimizer=optimizer,
            values=(*state.values, float(values.mean())),
            deviations=(*state.deviations, float(values.std())),
            path=(*state.path, state.reals),
        )

    def back(self, state: State, fault: str) -> State:
        """The last good parameters, those before the step with the fault."""
        if state.step == 0:
            raise RuntimeError(f"{self.caller}: {fault} at the start")
        fault = f"{fault} at step {state.step}"
        self.warn(fault, stacklevel=6)
        return replace(state, reals=state.path[-1], fault=fault)

    def warn(self, fault: str, stacklevel: int) -> None:
        """Say what was not finite."""
        message = f"{self.caller}: {fault}; its result is of the step before"
        warnings.warn(message, stacklevel=stacklevel)

    def finish(self, state: State) -> tuple[State, float]:
        """The end and the objective there; if that is not finite, the step before."""
        if state.fault is None:
            values, _, fault = self.evaluate(state)
            if fault is None:
                return state, float(values.mean())
            state = self.back(state, fault)
        return state, state.values[-1]

    def identity(self, name: str | None) -> dict[str, str]:
        """All that has to be the same for a checkpoint to be of this optimisation, by name."""
        leaves = jax.tree_util.tree_leaves_with_path(self.problem.tree)
        places = {
            f"parameters {name}": jax.tree_util.keystr(leaves[index][0])
            for name, index in self.problem.tuned
        }
        settings = {
            "transforms": self.problem.transforms,
            "key": self.key,
            "num_seeds": int(self.num_seeds),
            "common_random_numbers": bool(self.plan.common_random_numbers),
        }
        code = {"optimizer": self.optimizer} | self.code
        return places | identity_of(name, settings | self.settings, code)

    def save(self, file: Checkpoint, state: State, stopped: str | None) -> None:
        """Write the whole state, and why the optimisation ended, if it has."""
        rows = {
            name: np.array([point[name] for point in state.path], value.dtype)
            for name, value in state.reals.items()
        }
        rows = {name: row.reshape(-1, *state.reals[name].shape) for name, row in rows.items()}
        arrays = {
            "reals": state.reals, "optimizer": state.optimizer, "path": rows,
            "values": np.array(state.values), "deviations": np.array(state.deviations),
        }  # fmt: skip
        file.save(state.step, arrays, stopped=stopped, broken=state.fault is not None)

    def saved(self, file: Checkpoint, start: State) -> State:
        """The state that a file holds, or the start where there is none."""

        def like(notes: Notes) -> PyTree:
            by_step = np.zeros(notes["step"])
            rows = lambda u: jax.ShapeDtypeStruct((notes["step"], *u.shape), u.dtype)  # noqa: E731
            return {
                "reals": start.reals, "optimizer": start.optimizer,
                "path": jax.tree.map(rows, start.reals), "values": by_step, "deviations": by_step,
            }  # fmt: skip

        if not file.path.exists():
            return start
        notes, arrays = file.load(like)
        return State(
            step=notes["step"],
            reals=arrays["reals"],
            optimizer=arrays["optimizer"],
            values=tuple(map(float, arrays["values"])),
            deviations=tuple(map(float, arrays["deviations"])),
            path=tuple(
                {name: rows[k] for name, rows in arrays["path"].items()}
                for k in range(notes["step"])
            ),
            fault=notes["stopped"] if notes["broken"] else None,
        )
