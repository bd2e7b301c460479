"""Hydra entry points, one for each DVC stage."""

from polarnet.runtime.environment import let_threads_sleep

let_threads_sleep()  # here, because every module of this package loads torch at its first import
