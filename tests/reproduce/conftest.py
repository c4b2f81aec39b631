import pytest

from pemviz.reproduce import reproduce
from tests.reproduce.quick import QUICK


@pytest.fixture(scope="session")
def made():
    return reproduce(QUICK)
