"""One way to call things: what comes first, one name for one thing, defaults that agree."""

import importlib
import inspect
import re
from collections import defaultdict
from pathlib import Path

import mpfjax
from mpfjax import transforms
from mpfjax.moves.base import AbstractMove

DOCS = Path(__file__).resolve().parents[2] / "docs"
# Their first arguments are in the order of DESIGN's interface, or are data and no settings.
BY_POSITION = {
    "Filter", "MultiObjectModel", "QuadraticModel", "distributed_partitioned_sampling",
    "ParticleMixture", "Step", "StepInfo", "Detections", "read_frames",
}  # fmt: skip
# What one thing is called nowhere, as it has another name; and who alone may use a name.
GONE = {
    "among", "share_by", "position", "initial_draws", "checkpoint_every", "checkpoint_name",
    "num_metropolis_steps", "common_random_numbers", "adapt", "backward_steps",
}  # fmt: skip
ALONE = {
    "num_components": {"Filter", "ParticleMixture"},
    "function": {"smoothed_sums", "FixedLagSmoother"},
    "missing": {"run_filter", "monte_carlo", "run_islands"},
    "order": {"partitioned_sampling"},
}
# Different defaults under one name, because they count or bound different things.
DIFFERENT = {
    "collect",  # a study keeps numbers alone; a run keeps its mixtures
    "exponent",  # of a likelihood; of a distance
    "first",  # of a folder's frames, the first; of a tracker's, that of the detections
    "frames_per_second",  # of a tracker None asks; a video that is written must have one
    "min_distance",  # of poses None leaves none out; of components that are split, zero
    "num_iterations",  # of Newton, of K-means from seeds, and within one component
    "num_seeds",  # of a gradient, of a matrix of derivatives
    "reassembly",  # the paper's of its filter; the unbiased one of a move
    "regroup_every",  # a Gaussian of two modes loses both, a component of particles does not
}


def public():
    """Functions, classes, and their methods, by name, with their arguments.

    Records, whose fields are results, are left out.
    """
    names = importlib.import_module("api_names").public_names()
    for full in sorted(set(names.values())):
        module, _, name = full.rpartition(".")
        value = getattr(importlib.import_module(str(module)), name)
        methods = vars(value).items() if inspect.isclass(value) else ()
        if not (inspect.isclass(value) and issubclass(value, tuple)):
            yield name, arguments_of(value)
        for each, method in methods:
            if not each.startswith("_") and callable(method):
                yield f"{name}.{each}", arguments_of(method)


def arguments_of(function):
    """Its arguments, without the object that a method is of."""
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):  # of a base of JAX's own, which has no signature
        return []
    return [each for each in parameters if each.name not in ("self", "cls")]


def test_arguments_are_called_and_ordered_alike(monkeypatch):
    monkeypatch.syspath_prepend(DOCS / "_ext")
    faults, defaults = [], defaultdict(set)
    for name, arguments in public():
        places = [each.name for each in arguments if each.kind is not each.KEYWORD_ONLY]
        optional = [each for each in arguments if each.default is not each.empty]
        by_place = [each.name for each in optional if each.name in places]
        if {"key", "keys"} & {*places[1:]} and name != "Study":
            faults.append(f"{name}: its key is not first")
        if len(optional) > 2 and len(by_place) > 1 and name not in BY_POSITION:
            faults.append(f"{name}: {by_place} by position, of {len(optional)} that are optional")
        for each in arguments:
            is_free = "." in name or name in ALONE.get(each.name, {name})
            if each.name in GONE or not is_free:
                faults.append(f"{name}: {each.name} is called otherwise elsewhere")
        for each in optional:
            defaults[each.name].add(comparable(each.default))
    different = {name for name, values in defaults.items() if len(values) > 1}
    assert faults == []
    assert different == DIFFERENT


def comparable(default):
    """A default as text; one number for all dimensions is that number."""
    return repr(default[0] if isinstance(default, tuple) and len(default) == 1 else default)


def test_what_a_guide_names_is_at_the_top():
    """Moves, and filters that are made from filters."""
    names, waiting = {name for name in vars(transforms) if name.startswith("with_")}, [AbstractMove]
    while waiting:
        waiting += (below := waiting.pop().__subclasses__())
        names |= {each.__name__ for each in below if each.__module__.startswith("mpfjax.moves")}
    guides = [*DOCS.glob("*.md"), *DOCS.glob("gallery/*.md"), *DOCS.glob("papers/*.md")]
    for page in [DOCS.parent / "README.md", *guides]:
        named = set(re.findall(r"`(\w+)[`(]", page.read_text("utf-8"))) & names
        assert named <= set(dir(mpfjax)), page
