import importlib.util
import os
from pathlib import Path

import pytest

SHARED_DATA = Path(__file__).resolve().parents[3] / "shared" / "data"


def shared(name: str) -> Path:
    """A file of the development data; absent in a user's checkout, required in CI."""
    path = SHARED_DATA / name
    if not path.exists():
        if os.environ.get("CI") == "true":
            pytest.fail(f"CI must have {path}")
        pytest.skip(f"development data {path} is not here")
    return path


@pytest.fixture(scope="session")
def kitti_folder() -> Path:
    return shared("kitti_yolov3")


@pytest.fixture(scope="session")
def kitti_sample() -> Path:
    return shared("kitti_sample")


@pytest.fixture(scope="session")
def authors_checkpoint() -> Path:
    return shared("authors_pem/pem_ml_nn.safetensors")


@pytest.fixture(scope="session")
def pyro_installed():
    """Call it to skip (in CI: fail) where the optional package of b-nn is missing."""

    def check() -> None:
        if importlib.util.find_spec("pyro") is None:
            if os.environ.get("CI") == "true":
                pytest.fail("CI must have pyro-ppl")
            pytest.skip("pyro-ppl, needed for b-nn, is not installed")

    return check
