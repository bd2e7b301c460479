"""Studies of speed and quality, and the writers of the tables in README and docs; not part of the installed package."""

from polarnet.terminal.environment import let_threads_sleep

let_threads_sleep()  # here, because most modules of this package load torch at their first import
