"""The file formats of cameras and tools: one module each, which turns a file into blocks of columns."""
