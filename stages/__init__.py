"""Hydra entry points, one for each DVC stage."""

from polarnet.terminal.environment import announce_interrupts, let_threads_sleep, silence_bindings

announce_interrupts()
silence_bindings()
let_threads_sleep()  # here, because every module of this package loads torch at its first import
