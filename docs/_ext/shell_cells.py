"""``%%bash`` as a page shows it: plain text in one piece, and no lines of progress.

IPython's own hands out what a command prints in pieces of a hundred characters, with the colours of
a terminal.
"""

import os
import re
import subprocess
from typing import Any

PROGRESS = re.compile(r"^(repetition \d+ of \d+, )?stage \d+, .*\n", re.MULTILINE)


def bash(line: str, cell: str) -> None:
    """Carry out a cell; what it prints, errors too, is printed at once.

    Raises:
        RuntimeError: Its exit code is not 0.
    """
    plain = {name: value for name, value in os.environ.items() if not name.endswith("_COLOR")}
    command = ["bash", "-euo", "pipefail", "-c", cell]
    done = subprocess.run(  # noqa: S603  the pages' own commands
        command, check=False, env=plain, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    )
    print(PROGRESS.sub("", done.stdout), end="")
    if done.returncode:
        message = f"exit code {done.returncode}: {cell}{line}"
        raise RuntimeError(message)


def load_ipython_extension(shell: Any) -> None:
    """Take the place of IPython's ``%%bash``."""
    shell.register_magic_function(bash, magic_kind="cell")
