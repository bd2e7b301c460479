"""File formats of cameras and tools: each module turns one format into blocks of columns."""
