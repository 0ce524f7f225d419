"""Depth images with the intrinsics of their camera.

`intrinsics.txt` lies beside the image, or one folder up: the (3, 3) matrix, or fx fy cx cy; a number more is the units
per metre of the image (else 5000, as in TUM RGB-D and ICL-NUIM). Points are in the camera's frame, x to the right, y
down (up where fy is negative), z forward.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from slam.errors import LogError
from slam.io._numbers import ascii_of, text_rows
from slam.io.clouds.cloud import Cloud, checked
from slam.io.packed import read_bytes
from spplanes._check import FloatArray

INTRINSICS = "intrinsics.txt"
#: Units per metre of TUM RGB-D and ICL-NUIM.
USUAL_UNITS_PER_M = 5000.0
#: Larger images are refused before they are decoded, pixels.
MOST_PIXELS = 1 << 24


@dataclass(frozen=True)
class Camera:
    """A pinhole camera."""

    fx: float
    """Focal length along the rows, pixels."""
    fy: float
    """Focal length along the columns, pixels; negative: y is up."""
    cx: float
    """Column of the optical axis."""
    cy: float
    """Row of the optical axis."""
    units_per_m: float = USUAL_UNITS_PER_M
    """What a depth of 1 m is in the images."""

    def points(self, depth: FloatArray) -> FloatArray:
        """Points (H, W, 3) of depths (H, W), m, in the camera's frame; NaN where the depth is 0 or NaN."""
        v, u = np.mgrid[: depth.shape[0], : depth.shape[1]]
        z = np.where(depth > 0.0, depth, np.nan)
        return np.stack(((u - self.cx) / self.fx * z, (v - self.cy) / self.fy * z, z), axis=-1)


def read_depth_image(path: Path, camera: Camera | None = None) -> Cloud:
    """One depth image, 16 bits a pixel, as an organised cloud (H, W, 3).

    Args:
        path: the PNG.
        camera: None: that of intrinsics.txt beside the image or one folder up.

    Raises:
        LogError: no intrinsics, no PNG with one channel of whole numbers, one cut off, or no depth in it.
    """
    from PIL import Image

    camera = camera or _camera_of(path)
    try:
        with Image.open(path) as image:
            if image.width * image.height > MOST_PIXELS:
                raise LogError(path, f"expected at most {MOST_PIXELS} pixels, got {image.width} x {image.height}")
            if image.mode not in ("I;16", "I;16B", "I", "L"):
                raise LogError(path, f"expected one channel of 8 or 16 bits, got the mode {image.mode}")
            depth = np.asarray(image, dtype=np.float64) / camera.units_per_m
        _check_whole(path)
    except LogError:
        raise
    except FileNotFoundError as error:
        raise LogError(path, "expected a depth image, found no such file") from error
    except Exception as error:  # damaged PNGs raise OSError, SyntaxError, struct.error, zlib.error and others
        raise LogError(path, "expected a whole PNG, got one that cannot be read") from error
    return replace(checked(path, camera.points(depth)), is_depth_image=True)


def _check_whole(path: Path) -> None:
    """Refuse a PNG with fewer pixels than it has room for: Pillow fills up with zeros what a stream that ends lacks."""
    data = read_bytes(path)
    width, height, bits, _, _, _, interlaced = struct.unpack(">IIBBBBB", data[16:29])
    row = (width * bits + 7) // 8
    wanted = height * (row if interlaced else row + 1)
    stream, found, place = zlib.decompressobj(), 0, 8
    while place + 8 <= len(data) and found < wanted:
        size, kind = struct.unpack(">I4s", data[place : place + 8])
        if kind == b"IDAT":
            rest = data[place + 8 : place + 8 + size]
            while rest and found < wanted:
                found += len(stream.decompress(rest, 1 << 20))
                rest = stream.unconsumed_tail
        place += size + 12
    if found < wanted:
        raise LogError(path, f"expected {height} rows of {width} pixels, got a PNG that ends before")


def read_intrinsics(path: Path) -> Camera:
    """Read fx fy cx cy, or a (3, 3) matrix, and perhaps the units per metre.

    Raises:
        LogError: other numbers, or a matrix that is no camera's.
    """
    text = ascii_of(path, read_bytes(path)).replace("\n", " ").replace(",", " ")
    numbers = text_rows(path, text, None).ravel()
    if numbers.size in (4, 5):
        fx, fy, cx, cy = numbers[:4].tolist()
    elif numbers.size in (9, 10):
        fx, skew, cx, low, fy, cy, *last = numbers[:9].tolist()
        if (skew, low, *last) != (0.0, 0.0, 0.0, 0.0, 1.0):
            raise LogError(path, "expected a camera matrix (fx 0 cx, 0 fy cy, 0 0 1), got another")
    else:
        raise LogError(path, f"expected fx fy cx cy or a 3x3 matrix, perhaps with a scale, got {numbers.size} numbers")
    scale = float(numbers[-1]) if numbers.size in (5, 10) else USUAL_UNITS_PER_M
    if not np.isfinite(numbers).all() or fx == 0.0 or fy == 0.0 or scale <= 0.0:
        raise LogError(path, f"expected focal lengths and a scale that are not 0, got {fx:g}, {fy:g} and {scale:g}")
    return Camera(fx, fy, cx, cy, scale)


def _camera_of(path: Path) -> Camera:
    for place in (path.parent, path.parent.parent):
        if (place / INTRINSICS).is_file():
            return read_intrinsics(place / INTRINSICS)
    raise LogError(path, f"expected {INTRINSICS} (fx fy cx cy) beside the depth image, found none")
