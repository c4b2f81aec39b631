"""Where the sample run lies, in a checkout and in an installed wheel."""

from importlib import resources
from pathlib import Path

from pemviz.errors import InputError


def sample_run_path() -> Path:
    """The run folder of the sample: the wheel's copy if there is one, else the checkout's.

    Raises:
        InputError: Neither is there, as in a partial copy of the package.
    """
    installed = Path(str(resources.files("pemviz"))) / "_sample"
    checkout = Path(__file__).resolve().parents[2] / "recordings" / "sample"
    for candidate in (installed, checkout):
        if (candidate / "result.json").is_file():
            return candidate
    message = f"sample run not found: neither {installed} nor {checkout} holds a result.json"
    raise InputError(message)
