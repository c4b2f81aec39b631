import importlib.util
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.conftest import shared


@pytest.fixture(scope="session")
def kitti_folder() -> Path:
    return shared("kitti_yolov3")


@pytest.fixture(scope="session")
def kitti_sample() -> Path:
    return shared("kitti_sample")


@pytest.fixture(scope="session")
def pyro_installed() -> Callable[[], None]:
    """Call it to skip (in CI: fail) where the optional package of b-nn is missing."""

    def check() -> None:
        if importlib.util.find_spec("pyro") is None:
            if os.environ.get("PEMVIZ_REQUIRE_DATA") == "1":
                pytest.fail("CI must have pyro-ppl")
            pytest.skip("pyro-ppl, needed for b-nn, is not installed")

    return check
