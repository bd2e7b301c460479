"""Events of one polarizer channel: columns, windows of time, dense representations, streaming."""
