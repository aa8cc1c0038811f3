"""The type checker that the import hook of `conftest.py` runs mpfjax under."""

from beartype import BeartypeConf, beartype

# An int where a float is asked for is not a mistake (PEP 484's numeric tower).
typechecker = beartype(conf=BeartypeConf(is_pep484_tower=True))
