"""Every public name says what it is."""

import inspect

import pytest

import mpfjax

PUBLIC = {
    name: value
    for name, value in vars(mpfjax).items()
    if not name.startswith("_") and (inspect.isclass(value) or inspect.isfunction(value))
}
# Records of results and bases whose methods carry the description may do with one line.
BRIEF = {"StepInfo", "FilterRun", "AbstractProposal", "AbstractResampling", "AbstractPropagation"}


def is_method(value):
    return isinstance(value, property | staticmethod | classmethod) or inspect.isfunction(value)


METHODS = {
    f"{name}.{member}": value
    for name, owner in PUBLIC.items()
    if inspect.isclass(owner)
    for member, value in vars(owner).items()
    if not member.startswith("_") and is_method(value)
}


@pytest.mark.parametrize("name", PUBLIC)
def test_a_public_class_or_function_is_described(name):
    doc = inspect.getdoc(PUBLIC[name])
    assert doc, f"{name} has no docstring"
    if name not in BRIEF:
        assert len(doc.splitlines()) > 1, f"{name} is described in one line"


@pytest.mark.parametrize("name", METHODS)
def test_a_public_method_or_property_is_described(name):
    assert METHODS[name].__doc__
