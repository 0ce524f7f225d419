"""Checksums and packed members made whole round what the fuzzer invents: blind changes get no further than those."""

import io
import struct
import zipfile
import zlib
from collections.abc import Callable

import numpy as np

from tests.fuzz.target import NEXT_FILE

_PAGE, _SUM = 1024, 4
_LENGTH = struct.Struct("<I")
#: CRC-32C (Castagnoli) by byte.
_TABLE = np.arange(256, dtype=np.uint32)
for _ in range(8):
    _TABLE = np.where(_TABLE & 1, (_TABLE >> 1) ^ np.uint32(0x82F63B78), _TABLE >> 1).astype(np.uint32)


def zipped(*names: str) -> Callable[[bytes], bytes]:
    """The files of one input as the members of an archive."""

    def wrap(data: bytes) -> bytes:
        stream = io.BytesIO()
        with zipfile.ZipFile(stream, "w") as archive:
            for name, part in zip(names, data.split(NEXT_FILE, len(names) - 1), strict=False):
                archive.writestr(name, part)
        return stream.getvalue()

    return wrap


def record(data: bytes) -> bytes:
    """A record of a session out of its text and its arrays, a NUL between them; the length before them holds."""
    text, _, arrays = data.partition(b"\0")
    return _LENGTH.pack(len(text)) + text + arrays


def unrecorded(data: bytes) -> bytes:
    """Inverse of `record`."""
    (size,) = _LENGTH.unpack_from(data)
    text = data[_LENGTH.size : _LENGTH.size + size]
    return text + b"\0" + data[_LENGTH.size + size :]


def png(data: bytes) -> bytes:
    """A PNG of a header (13 bytes) and its rows, with checksums that hold."""
    header, rows = data[:13].ljust(13, b"\0"), data[13:]
    pieces = ((b"IHDR", header), (b"IDAT", zlib.compress(rows, 1)), (b"IEND", b""))
    framed = (
        len(content).to_bytes(4, "big") + kind + content + zlib.crc32(kind + content).to_bytes(4, "big")
        for kind, content in pieces
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(framed)


def e57(data: bytes) -> bytes:
    """Pages of an E57 file with checksums that hold; a page cut short is filled up."""
    pages = np.frombuffer(data.ljust(-(-len(data) // _PAGE) * _PAGE, b"\0"), dtype=np.uint8).reshape(-1, _PAGE).copy()
    sums = np.full(len(pages), 0xFFFFFFFF, dtype=np.uint32)
    for column in pages[:, : _PAGE - _SUM].T:
        sums = _TABLE[(sums ^ column) & 0xFF] ^ (sums >> np.uint32(8))
    pages[:, _PAGE - _SUM :] = (sums ^ np.uint32(0xFFFFFFFF)).astype(">u4").view(np.uint8).reshape(-1, _SUM)
    return pages.tobytes()
