"""The process of an `IsolatedLibrary`: answers requests with the TASKS of the file given at its start.

Requests arrive pickled on standard input, and pickled answers go to standard output. It imports nothing of polarnet, so
that it starts quickly.
"""

import contextlib
import pickle
import runpy
import sys
from typing import Any


def serve(tasks: dict[str, Any]) -> None:
    """Answer requests until the input ends."""
    requests, answers = sys.stdin.buffer, sys.stdout.buffer
    reply: tuple[str, Any]
    while True:
        try:
            task, *arguments = pickle.load(requests)
        except EOFError:
            return
        try:
            reply = ("answer", tasks[task](*arguments))
        except BaseException as error:  # HDF5 raises many kinds, and a panic in Rust code is not an Exception
            reply = ("error", f"{type(error).__name__}: {error}"[:500])
        pickle.dump(reply, answers, protocol=5)
        answers.flush()


def limit_memory(mib: int) -> None:
    """Make allocations beyond the limit fail, where the system supports it."""
    with contextlib.suppress(ImportError, ValueError):
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (mib * 2**20, resource.getrlimit(resource.RLIMIT_AS)[1]))


if __name__ == "__main__":
    limit_memory(int(sys.argv[2]))
    serve(runpy.run_path(sys.argv[1])["TASKS"])
