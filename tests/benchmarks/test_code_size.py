"""The counts of a checkout, of a library that is small enough to count by hand."""

from benchmarks import code_size

ROOT = '''"""A library."""

from mpfjax.parts import Thing as Thing
from mpfjax.parts import make as make
from mpfjax.parts import helper
'''
PARTS = '''"""Parts.

Two lines more.
"""


class Thing:
    """A thing."""

    first: int  # counts
    second: int = 0


# A comment does not count.
def make(one, two, *, three):
    """Make it."""

    def inner():
        return one

    return inner


def helper(a, b, c, d):
    return a
'''


def test_a_small_library_is_counted(tmp_path, capsys):
    package = tmp_path / "mpfjax"
    package.mkdir()
    (package / "__init__.py").write_text(ROOT)
    (package / "parts.py").write_text(PARTS)
    assert code_size.main([str(tmp_path)]) == 0
    line = capsys.readouterr().out.splitlines()[-1].split()
    assert line[1:] == ["2", "12", "2", "3", "(make)"]


def test_what_is_no_checkout_is_one_line(tmp_path, capsys):
    assert code_size.main([str(tmp_path)]) == 2
    assert "holds no mpfjax" in capsys.readouterr().err
