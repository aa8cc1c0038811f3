"""Names say what things are, and former names still work with a warning."""

import ast
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

import mpfjax
from mpfjax import smoothing

PACKAGE = Path(__file__).resolve().parents[2] / "mpfjax"
FILES = sorted(PACKAGE.rglob("*.py"))

# Words that say what was done to a thing, and not what it is.
PARTICIPLES = "begun found given gone held joined kept known made own said seen taken told"
# Words in -ed of the field, or no participles.
ESTABLISHED = """
    antithetic checked clustered constrained coupled distributed embed expected feed filtered guided
    marginalised need nested normalised partitioned predicted red regularised scrambled seed
    segmented shared smoothed speed stored stratified tempered truncated twisted unbounded
    unconstrained unnormalised weighted whitened
"""
# Adjectives of arrays, before their noun only: `padded_rows`.
BEFORE_A_NOUN = """
    blocked centred fixed learned masked padded reversed rotated sampled scaled scattered shifted
    signed sorted squared transposed
"""
RELATIVE = re.compile(r"(The same|That of|Those of)\b")

# What is still allowed. Former names count, and public names that would not be clearer otherwise.
ALLOWED_NAMES = {
    "vision/boxes/colour_model.py": {"own"},
    "vision/tracking/state.py": {"begun"},
}
ALLOWED_FUNCTIONS = {
    "mixture.py": {"occupied"},
    "models/dynamics.py": {"remembered"},
    "robots/maps.py": {"tabulated"},
    "robots/localisation.py": {"interpolated_poses"},
    "robots/pose.py": {"localised"},
    "tuning/densities.py": {"adapted", "evaluated"},
    "tuning/mcmc.py": {"changed"},
    "tuning/sequential.py": {"followed_by", "resampled"},
}


def is_participle(name):
    """Whether a function is named by a participle."""
    first, *more = name.strip("_").lower().split("_")
    if first in PARTICIPLES.split():
        return True
    if not first.endswith("ed") or first in ESTABLISHED.split():
        return False
    return not (more and first in BEFORE_A_NOUN.split())


def names_of(tree):
    """The names of what is assigned, taken as an argument or looped over, and of fields."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.attr
        elif isinstance(node, ast.arg):
            yield node.arg
        elif isinstance(node, ast.ExceptHandler | ast.MatchAs | ast.MatchStar) and node.name:
            yield node.name


def parsed(path):
    return ast.parse(path.read_text(encoding="utf-8"))


def functions_of(tree):
    return (node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef))


def refused(names_of_tree, is_wrong, allowed):
    """The names for which this is true, with their files, unless they are allowed."""
    return [
        f"{file}: {name}"
        for path in FILES
        for name in sorted(set(filter(is_wrong, names_of_tree(parsed(path)))))
        if name not in allowed.get(file := path.relative_to(PACKAGE).as_posix(), ())
    ]


def test_names_are_no_participles():
    wrong = refused(names_of, lambda name: name.strip("_") in PARTICIPLES.split(), ALLOWED_NAMES)
    assert not wrong


def test_functions_are_verbs_or_what_they_return():
    assert not refused(functions_of, is_participle, ALLOWED_FUNCTIONS)


def test_docstrings_say_their_subject():
    kinds = ast.Module | ast.ClassDef | ast.FunctionDef
    wrong = [
        f"{path.relative_to(PACKAGE)}: {text}"
        for path in FILES
        for node in ast.walk(parsed(path))
        if isinstance(node, kinds) and RELATIVE.match(text := ast.get_docstring(node) or "")
    ]
    assert not wrong


MODEL = mpfjax.QuadraticModel()
FILTER = mpfjax.particle_filter(MODEL, 8)
KEY = jax.random.key(0)
OBSERVATIONS = jnp.ones(3)


@pytest.mark.parametrize("old", mpfjax._FORMER)
def test_a_former_name_of_the_library_warns_at_the_line_that_uses_it(old):
    new = mpfjax._FORMER[old]
    with pytest.warns(DeprecationWarning, match=f"mpfjax.{old} is now called {new}") as caught:
        assert getattr(mpfjax, old) is getattr(mpfjax, new)
    assert caught[0].filename == __file__
    with pytest.warns(DeprecationWarning, match=new) as caught:
        exec(compile(f"from mpfjax import {old}", __file__, "exec"), {"__name__": __name__})
    assert caught[-1].filename == __file__
    assert old not in dir(mpfjax)


def test_former_names_of_attributes_and_arguments_warn():
    mixture = FILTER.init(KEY)
    with pytest.warns(DeprecationWarning, match="average is now called expectation"):
        assert mixture.average(mixture.particles) == mixture.expectation(mixture.particles)
    with pytest.warns(DeprecationWarning, match="component_averages is now called"):
        mixture.component_averages(mixture.particles)
    with pytest.warns(DeprecationWarning, match="weighed is now called reweight"):
        mixture.weighed(jnp.zeros(8))
    with pytest.warns(DeprecationWarning, match="slots: .* num_slots") as caught:
        runs = mpfjax.monte_carlo(KEY[None], FILTER, OBSERVATIONS, slots=10)
    assert caught[0].filename == __file__
    with pytest.warns(DeprecationWarning, match="FilterRun.surprised is now called alarm"):
        assert runs.surprised is None


def test_trajectories_of_a_model_in_the_place_of_its_filter_warn():
    run = mpfjax.run_filter(KEY, FILTER, OBSERVATIONS)
    expected = smoothing.sample_trajectories(KEY, FILTER, run, 4)
    with pytest.warns(DeprecationWarning, match="now takes the filter"):
        paths = smoothing.sample_trajectories(KEY, MODEL, run, 4)
    assert (paths == expected).all()
    with pytest.warns(DeprecationWarning, match="the filter|called filter") as caught:
        smoothing.sample_trajectories(KEY, model=MODEL, mixtures=run, num_trajectories=4)
    assert {each.filename for each in caught} == {__file__}
