"""Environment variables of polarnet's programs; a user's own program keeps its own."""

import os


def let_threads_sleep() -> None:
    """Let waiting OpenMP threads sleep after a short while; call this before anything loads torch.

    Threads that spin would take the cores from another process, such as a second job or a CI runner. They do not sleep
    at once, because a network is many short operations (`GOMP_SPINCOUNT=0 python -m studies.training` compares).
    Variables that are set already stay.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    os.environ.setdefault("GOMP_SPINCOUNT", "10000")  # turns of a loop
