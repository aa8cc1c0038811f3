"""Known inputs u_t, and the models that take them."""

import contextlib
import copy
from collections.abc import Iterator
from typing import Any

from jaxtyping import PyTree


def takes_inputs(model: Any) -> bool:
    """Whether a model takes u_t: it has a field `inputs`, or its own `with_inputs`."""
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
    """The model with u_t, or unchanged where there is none, or where it takes none."""
    if inputs is None or not takes_inputs(model):
        return model
    if hasattr(model, "with_inputs"):
        return model.with_inputs(inputs)
    return replaced(model, inputs=inputs)


def replaced(model: Any, **fields: Any) -> Any:
    """A copy of a model with some fields set, without checks or conversions."""
    changed = copy.copy(model)
    for name, value in fields.items():
        object.__setattr__(changed, name, value)
    return changed


@contextlib.contextmanager
def saying_that_none_were_given(model: Any) -> Iterator[None]:
    """Add to an error about None that the model's field `inputs` is None.

    A model may do without inputs. So whether it needs them is known only where it fails.
    """
    try:
        yield
    except Exception as error:
        while not hasattr(model, "inputs"):  # of one particle, or of one object
            model = getattr(model, "model", getattr(model, "object_model", error))
            if model is error:
                raise
        note = (
            f"mpfjax: inputs: there are none, so {type(model).__name__}.inputs is None; give"
            " u_1, ..., u_t by inputs=... (x_0 has no input)"
        )
        said = getattr(error, "__notes__", [])
        if model.inputs is None and "None" in str(error) and note not in said:
            error.add_note(note)
        raise
