"""Decoder of LZF, the compression inside PCD files."""

from __future__ import annotations

import numpy as np

from spplanes._jit import njit

#: Most bytes that one byte of LZF can stand for: three bytes say "repeat 264 bytes".
MOST_PER_BYTE = 88


def lzf_decompress(data: bytes, size: int) -> bytes:
    """Decompress a block of which the decompressed size is known.

    The stream is a row of pieces. A first byte below 32 says how many bytes, less one, follow as they are. Any other
    holds in its upper three bits the length, less two, of a repetition (7: the next byte is added to it) and in its
    lower five the upper bits of how far back, less one, it starts; the last byte of the piece holds the lower eight.

    Raises:
        ValueError: the sizes cannot belong together (nothing is allocated then), or the stream is damaged.
    """
    if size > MOST_PER_BYTE * len(data):
        raise ValueError(f"{len(data)} compressed bytes cannot hold the {size} that are declared")
    out = np.empty(size, dtype=np.uint8)
    if _decode(np.frombuffer(data, dtype=np.uint8), out) != size:
        raise ValueError("the compressed data are cut off or damaged")
    return out.tobytes()


@njit(cache=True)
def _decode(data, out):
    """Bytes written; -1 where the stream reaches beyond its ends."""
    i, o = 0, 0
    while i < len(data):
        first = np.int64(data[i])
        i += 1
        if first < 32:
            length = first + 1
            if i + length > len(data) or o + length > len(out):
                return -1
            for k in range(length):
                out[o + k] = data[i + k]
            i += length
        else:
            length = first >> 5
            if length == 7:
                if i >= len(data):
                    return -1
                length += np.int64(data[i])
                i += 1
            length += 2
            if i >= len(data):
                return -1
            start = o - ((first & 31) << 8) - np.int64(data[i]) - 1
            i += 1
            if start < 0 or o + length > len(out):
                return -1
            for k in range(length):  # byte by byte: a repetition may overlap itself
                out[o + k] = out[start + k]
        o += length
    return o
