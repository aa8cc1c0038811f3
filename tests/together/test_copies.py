"""Objects of the library survive `pickle` and `copy.deepcopy`, as process pools ask of them."""

import copy
import dataclasses
import importlib
import inspect
import pickle

import pytest

MODULES = ("mpfjax", "mpfjax.robots", "mpfjax.tuning", "mpfjax.smoothing", "mpfjax.exact",
           "mpfjax.vision", "mpfjax.smoothing.variance", "mpfjax.tuning.mcmc",
           "mpfjax.tuning.sequential")  # fmt: skip
PUBLIC = {
    name: value
    for module in map(importlib.import_module, MODULES)
    for name in dir(module)
    for value in [getattr(module, name)]
    if inspect.isclass(value) and value.__module__.startswith("mpfjax.")
}
CLASSES = {
    name: value
    for name, value in PUBLIC.items()
    if dataclasses.is_dataclass(value) and not inspect.isabstract(value) and name[0] != "_"
}


@pytest.mark.parametrize("name", CLASSES)
def test_a_copy_has_the_same_fields(name):
    """Of a bare object, whatever its constructor asks for."""
    one = object.__new__(CLASSES[name])
    for field in dataclasses.fields(CLASSES[name]):
        object.__setattr__(one, field.name, f"the value of {field.name}")
    for again in (pickle.loads(pickle.dumps(one)), copy.deepcopy(one), copy.copy(one)):
        assert type(again) is type(one)
        assert vars(again) == vars(one)
