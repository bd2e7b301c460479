"""Parts of stores, changed and damaged on purpose."""

import os
import struct
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import zarr
from zarr.abc.buffer import Buffer
from zarr.core.buffer import default_buffer_prototype
from zarr.storage import MemoryStore

from polarnet.storage.parts import DIGEST_LENGTH, _digests, _signed

LOCAL_HEADER = struct.Struct("<4s5HLLLHH")


def entries_of(part: Path) -> list[str]:
    with zipfile.ZipFile(part) as archive:
        return archive.namelist()


def flip(part: Path, entry: str) -> None:
    """Flip a bit in the middle of an entry."""
    with zipfile.ZipFile(part) as archive:
        info = archive.getinfo(entry)
    with part.open("r+b") as file:
        file.seek(info.header_offset)
        *_, name_length, extra_length = LOCAL_HEADER.unpack(file.read(LOCAL_HEADER.size))
        middle = info.header_offset + LOCAL_HEADER.size + name_length + extra_length + info.file_size // 2
        file.seek(middle)
        (byte,) = file.read(1)
        file.seek(middle)
        file.write(bytes([byte ^ 4]))


@contextmanager
def entries_to_change(part: Path) -> Iterator[dict[str, Buffer]]:
    """The entries of a part, for a foreign writer; part and header then get the digest of the new bytes."""
    buffer = default_buffer_prototype().buffer
    with zipfile.ZipFile(part) as archive:
        entries = {name: buffer.from_bytes(archive.read(name)) for name in archive.namelist()}
    yield entries
    with zipfile.ZipFile(part, "w") as archive:
        for name, content in entries.items():
            archive.writestr(zipfile.ZipInfo(name), content.to_bytes())
        archive.comment = bytes(DIGEST_LENGTH)
    with part.open("r+b") as file:
        digest, _ = _digests(file)
        file.seek(-DIGEST_LENGTH, os.SEEK_END)
        file.write(digest)
    store = zarr.open_group(part.parent, mode="r+")
    header = {key: value for key, value in store.attrs.items() if key != "checksum"}
    header["digests"][part.stem] = digest.decode()
    store.attrs.put(_signed(header))


@contextmanager
def group_to_change(part: Path) -> Iterator[zarr.Group]:
    """As `entries_to_change`, but the group."""
    with entries_to_change(part) as entries:
        yield zarr.open_group(MemoryStore(entries), mode="r+")
