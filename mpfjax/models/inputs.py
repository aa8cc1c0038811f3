"""Known inputs u_t, and the models that have a place for them."""

import copy
from typing import Any

from jaxtyping import PyTree


def takes_inputs(model: Any) -> bool:
    """Whether a model has a place for u_t: a field `inputs`, or its own `with_inputs`."""
    if hasattr(type(model), "takes_inputs"):
        return model.takes_inputs
    # A model of one particle may be of any class.
    return hasattr(model, "with_inputs") or hasattr(model, "inputs")


def has_attribute(model: Any, name: str) -> bool:
    """Whether the model has it; a property may need inputs, which are not there before a run."""
    try:
        return hasattr(model, name)
    except Exception:
        return True


def with_inputs(model: Any, inputs: PyTree) -> Any:
    """The model with u_t, or as it is where there is none, or no place for it."""
    if inputs is None or not takes_inputs(model):
        return model
    if hasattr(model, "with_inputs"):
        return model.with_inputs(inputs)
    return replaced(model, inputs=inputs)


def replaced(model: Any, **fields: Any) -> Any:
    """A copy of a model with some fields set, which nothing checks or converts again."""
    changed = copy.copy(model)
    for name, value in fields.items():
        object.__setattr__(changed, name, value)
    return changed
