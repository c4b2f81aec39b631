"""A limit on how long a call may take, for simulators that may hang."""

import threading
from collections.abc import Callable
from typing import TypeVar

Result = TypeVar("Result")


def call_within(limit_s: float | None, call: Callable[[], Result]) -> Result:
    """The result of ``call``, or what it raises, within ``limit_s`` seconds; no limit if None.

    A call that takes longer is left behind in a thread of its own, which does not keep the
    process alive: Python cannot end it.

    Raises:
        TimeoutError: There is no result yet.
    """
    if limit_s is None:
        return call()
    results: list[Result] = []
    errors: list[BaseException] = []

    def work() -> None:
        try:
            results.append(call())
        except BaseException as error:  # handed on to the caller
            errors.append(error)

    thread = threading.Thread(target=work, name="pemviz-batch", daemon=True)
    thread.start()
    thread.join(limit_s)
    if errors:
        raise errors[0]
    if not results:
        raise TimeoutError
    return results[0]
