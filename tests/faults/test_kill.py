"""The kill test at a size for every run of CI; at full size by hand (see CONTRIBUTING)."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.slow
def test_runs_killed_at_random_moments_end_the_same():
    words = [sys.executable, "-m", "tests.faults.kill", "--count", "6", "--seed", "1"]
    done = subprocess.run(words, check=False, cwd=ROOT, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr[-2000:]
    assert "6 of 6 runs" in done.stdout
