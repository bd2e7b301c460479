"""Files of stores, damaged on purpose."""

from pathlib import Path


def flip(file: Path, place: float = 0.5) -> None:
    """Flip a bit of a file, at a fraction of its length."""
    content = bytearray(file.read_bytes())
    content[int(place * len(content))] ^= 4
    file.write_bytes(content)


def files_of(folder: Path) -> dict[str, bytes]:
    """Content of every file below a folder."""
    return {str(file.relative_to(folder)): file.read_bytes() for file in sorted(folder.rglob("*")) if file.is_file()}
