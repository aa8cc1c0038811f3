"""A whole study is one of the thorough tests; what a command refuses is tried always."""

import pytest

STUDIES = {"finished", "content", "folder"}


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    for item in items:
        # Called with the tests of all folders.
        if "benchmarks" in item.path.parts and STUDIES & set(getattr(item, "fixturenames", ())):
            item.add_marker(pytest.mark.thorough)
