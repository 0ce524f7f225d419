"""Clouds in files: what others wrote is read as they meant it; what is damaged is one sentence."""

import io
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slam.errors import LogError
from slam.io.clouds import is_cloud_file, read_cloud
from slam.io.clouds.pcd import lzf_decompress
from tests.slam.real_data import needs

#: Multiples of 1/64: the same in every format.
POINTS = (np.round(np.random.default_rng(0).normal(0.0, 5.0, (300, 3)) * 64.0) / 64.0).astype(np.float32)
PCD_HEADER = """# .PCD v0.7
VERSION 0.7
FIELDS x y z
SIZE 4 4 4
TYPE F F F
COUNT 1 1 1
WIDTH {n}
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS {n}
DATA {data}
"""


def pcd(data: str = "binary", n: int = len(POINTS), body: bytes | None = None) -> bytes:
    """A PCD file; the body may be another than the header says."""
    if body is None:
        body = POINTS.tobytes() if data == "binary" else "\n".join(" ".join(map(str, p)) for p in POINTS).encode()
    return PCD_HEADER.format(n=n, data=data).encode() + body


PLY_TYPES = ("uchar", "float", "float", "float")


def ply(points: np.ndarray = POINTS, *, text: bool = False, order: str = "<") -> bytes:
    table = np.empty(len(points), dtype=[("intensity", "u1"), ("x", "f4"), ("y", "f4"), ("z", "f4")])
    table["intensity"] = 7
    for k, axis in enumerate("xyz"):
        table[axis] = points[:, k]
    kind = "ascii" if text else {"<": "binary_little_endian", ">": "binary_big_endian"}[order]
    properties = [f"property {name} {column}" for name, column in zip(PLY_TYPES, table.dtype.names, strict=True)]
    header = ["ply", f"format {kind} 1.0", f"element vertex {len(table)}", *properties, "end_header", ""]
    rows = "".join(" ".join(f"{value:.9g}" for value in row) + "\n" for row in table.tolist()).encode()
    return "\n".join(header).encode() + (rows if text else table.astype(table.dtype.newbyteorder(order)).tobytes())


def npy(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def npz(**arrays: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)  # type: ignore[arg-type]
    return stream.getvalue()


def text(points: np.ndarray = POINTS, head: str = "", between: str = " ") -> bytes:
    return (head + "\n".join(between.join(map(repr, p.tolist())) for p in points) + "\n").encode()


KITTI = np.column_stack((POINTS, np.zeros(len(POINTS), dtype=np.float32)))


def lzf_literals(data: bytes) -> bytes:
    """LZF that compresses nothing."""
    return b"".join(bytes([len(data[k : k + 32]) - 1]) + data[k : k + 32] for k in range(0, len(data), 32))


#: All x, all y, all z.
PACKED = lzf_literals(POINTS.T.tobytes())


def compressed(packed: bytes, size: int, n: int = len(POINTS)) -> bytes:
    return pcd("binary_compressed", n, struct.pack("<II", len(packed), size) + packed)


#: Files that hold `POINTS`.
CLOUD_FILES = {
    "binary.pcd": pcd(),
    "compressed.pcd": compressed(PACKED, 3600),
    "ascii.pcd": pcd("ascii"),
    "little.ply": ply(),
    "big.ply": ply(order=">"),
    "text.ply": ply(text=True),
    "blanks.xyz": text(),
    "commas.csv": text(head="x,y,z\n", between=","),
    "counted.pts": text(head=f"{len(POINTS)}\n"),
    "commented.txt": text(head="# made by a scanner\n//X Y Z\n"),
    "swapped.csv": text(POINTS[:, ::-1], head="z;y;x\n", between=";"),
    "kitti.bin": KITTI.tobytes(),
    "wide.npy": npy(KITTI.astype(np.float64)),
    "swapped bytes.npy": npy(POINTS.astype(">f4")),
    "fortran.npy": npy(np.asfortranarray(POINTS)),
    "one.npz": npz(cloud=POINTS),
    "two.npz": npz(points=POINTS, labels=np.zeros(3)),
    "Name with blanks, ünïcode 点群.pcd": pcd(),
}


@pytest.mark.parametrize("name", CLOUD_FILES)
def test_a_cloud_is_read(name: str, tmp_path: Path):
    (tmp_path / name).write_bytes(CLOUD_FILES[name])
    cloud = read_cloud(tmp_path / name)
    np.testing.assert_array_equal(cloud.points, POINTS.astype(np.float64))
    assert cloud.points.dtype == np.float64 and cloud.points.flags.c_contiguous
    assert cloud.world_T_sensor is None


OPEN3D = [
    ("c.pcd", {"write_ascii": True}),
    ("c.pcd", {}),
    ("c.pcd", {"compressed": True}),
    ("c.ply", {}),
    ("c.xyz", {}),
]


@pytest.mark.parametrize(("name", "options"), OPEN3D)
def test_what_open3d_writes(name: str, options: dict, tmp_path: Path):
    o3d = pytest.importorskip("open3d")
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(POINTS))
    cloud.colors = o3d.utility.Vector3dVector(np.full((len(POINTS), 3), 0.5))
    assert o3d.io.write_point_cloud(str(tmp_path / name), cloud, **options)
    np.testing.assert_allclose(read_cloud(tmp_path / name).points, POINTS, atol=1e-6)


@pytest.mark.parametrize("name", ["pcl_room/room_scan1.pcd", "balm_hall/000.pcd", "synpeb/test_100.pcd"])
def test_real_pcd_files_as_open3d_reads_them(name: str):
    o3d = pytest.importorskip("open3d")
    path = needs(name)
    theirs = np.asarray(o3d.io.read_point_cloud(str(path), remove_nan_points=False).points)
    np.testing.assert_array_equal(read_cloud(path).points.reshape(-1, 3), theirs)


def test_organised_pcd_keeps_its_rows_and_nan(tmp_path: Path):
    points = POINTS.copy()
    points[5, 1] = np.nan
    points[7] = np.inf
    head = PCD_HEADER.replace("WIDTH {n}", "WIDTH 30").replace("HEIGHT 1", "HEIGHT 10").format(n=300, data="binary")
    (tmp_path / "c.pcd").write_bytes(head.encode() + points.tobytes())
    grid = read_cloud(tmp_path / "c.pcd").points
    assert grid.shape == (10, 30, 3)
    assert np.argwhere(np.isnan(grid[..., 0])).tolist() == [[0, 5], [0, 7]]
    np.testing.assert_array_equal(grid[3, 4], POINTS[94])


def test_pcd_fields_in_any_order_type_and_count(tmp_path: Path):
    dtype = np.dtype([("n", "<u2", (3,)), ("z", "<f8"), ("fill", "u1", (4,)), ("x", "<f4"), ("y", "<i2")])
    table = np.zeros(4, dtype=dtype)
    table["x"], table["y"], table["z"] = [1.5, 2.5, 3.5, 4.5], [1, 2, 3, 4], [-1.0, -2.0, -3.0, -4.0]
    head = "VERSION .7\nFIELDS normal z _ x y\nSIZE 2 8 1 4 2\nTYPE U F U F I\nCOUNT 3 1 4 1 1\nWIDTH 4\nHEIGHT 1\n"
    (tmp_path / "c.pcd").write_bytes(head.encode() + b"POINTS 4\nDATA binary\n" + table.tobytes())
    wanted = np.column_stack((table["x"], table["y"], table["z"]))
    np.testing.assert_array_equal(read_cloud(tmp_path / "c.pcd").points, wanted)


def test_a_viewpoint_is_where_the_sensor_was(tmp_path: Path):
    half = np.sqrt(0.5)
    data = pcd().replace(b"VIEWPOINT 0 0 0 1 0 0 0", f"VIEWPOINT 1 2 3 {half} 0 0 {half}".encode())
    (tmp_path / "c.pcd").write_bytes(data)
    cloud = read_cloud(tmp_path / "c.pcd")
    pose = cloud.world_T_sensor
    np.testing.assert_allclose(pose[:3, :3] @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(cloud.points @ pose[:3, :3].T + pose[:3, 3], POINTS, atol=1e-12)


@given(st.binary(max_size=300))
def test_lzf_literals(data: bytes):
    assert lzf_decompress(lzf_literals(data), len(data)) == data


def test_lzf_repetitions():
    # "ab", then 2 + 7 + 1 = 10 bytes from 2 back (it overlaps itself), then 3 bytes from 12 back
    packed = bytes([1]) + b"ab" + bytes([7 << 5, 1, 1]) + bytes([1 << 5, 11])
    assert lzf_decompress(packed, 15) == b"ab" * 6 + b"aba"
    far = bytes(range(256)) * 3
    packed = lzf_literals(far) + bytes([(5 << 5) | (700 >> 8), 700 & 255])
    assert lzf_decompress(packed, 768 + 7) == far + far[768 - 701 :][:7]


def zip_bomb() -> bytes:
    """4 GB of zeros in 4 MB would take long to make: a member whose directory says what it grows to."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("points.npy", npy_head(1 << 27) + bytes(1 << 16))
    data = bytearray(stream.getvalue())
    for mark, place in ((b"PK\x03\x04", 22), (b"PK\x01\x02", 24)):
        struct.pack_into("<I", data, data.index(mark) + place, (1 << 31) - 1)
    return bytes(data)


def ply_head(count: object, order: str = "binary_little_endian", more: str = "") -> bytes:
    axes = "".join(f"property float {axis}\n" for axis in "xyz")
    return f"ply\nformat {order} 1.0\nelement vertex {count}\n{axes}{more}end_header\n".encode()


def npy_head(count: int) -> bytes:
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": "<f8", "fortran_order": False, "shape": (count, 3)})
    return stream.getvalue()


SWAPPED = POINTS.astype(">f4").tobytes()
NO_POINTS = np.full((3, 3), np.nan, dtype=np.float32)

BAD: dict[str, tuple[str, bytes, str]] = {
    "pcd empty": ("c.pcd", b"", "expected a PCD header that ends with DATA"),
    "pcd other": ("c.pcd", b"\x89PNG\r\n\x1a\n" * 30, r"c.pcd:1: expected a line of a PCD header"),
    "pcd cut in the header": ("c.pcd", pcd()[:80], "expected a PCD header that ends with DATA"),
    "pcd cut": ("c.pcd", pcd()[:-1], "expected 3600 bytes for 300 points, got 3599"),
    "pcd text cut": ("c.pcd", pcd("ascii", body=b"1.25 2 3\n" * 250), "expected 300 points, got 250 lines"),
    "pcd text cut in a line": ("c.pcd", pcd("ascii", 2, b"1 2 3\n4 55\n"), "c.pcd:13: expected 3 numbers, got 2 words"),
    "pcd text of words": ("c.pcd", pcd("ascii", 2, b"1 2 3\n4 x 5\n"), "c.pcd:13: expected numbers, got '4 x 5'"),
    "pcd huge": ("c.pcd", pcd(n=10**12), "expected 12000000000000 bytes for 1000000000000 points"),
    "pcd text huge": ("c.pcd", pcd("ascii", n=10**15), "bytes for 1000000000000000 points"),
    "pcd count of words": ("c.pcd", pcd().replace(b"WIDTH 300", b"WIDTH -3"), "expected 1 whole numbers in WIDTH"),
    "pcd counts that differ": ("c.pcd", pcd().replace(b"POINTS 300", b"POINTS 3"), "WIDTH x HEIGHT = 300 points, got"),
    "pcd without z": ("c.pcd", pcd().replace(b"x y z", b"x y i"), "expected one field z, got the fields x y i"),
    "pcd odd type": ("c.pcd", pcd().replace(b"SIZE 4 4 4", b"SIZE 4 3 4"), "expected a type F, I or U of 1 to 8 bytes"),
    "pcd huge fields": ("c.pcd", pcd().replace(b"COUNT 1 1 1", b"COUNT 1 1 99999999"), "expected one field z|1 to 8"),
    "pcd odd data": ("c.pcd", pcd("zstd"), "expected DATA ascii, binary or binary_compressed, got 'zstd'"),
    "pcd odd viewpoint": ("c.pcd", pcd().replace(b"0 0 0 1 0 0 0", b"0 0 0 9 0 0 0"), "unit quaternion in VIEWPOINT"),
    "pcd other byte order": ("c.pcd", pcd(body=SWAPPED), "got numbers as of another byte order or type"),
    "pcd all nan": ("c.pcd", pcd(n=3, body=bytes(NO_POINTS)), "expected at least one point, got none that is finite"),
    "pcd none": ("c.pcd", pcd(n=0, body=b""), "expected at least one point, got none"),
    "pcd packed cut": ("c.pcd", compressed(PACKED, 3600)[:-5], "bytes for the compressed data, got"),
    "pcd packed no sizes": ("c.pcd", compressed(b"", 0)[:-5], "expected the sizes of the compressed data"),
    "pcd packed damaged": ("c.pcd", compressed(b"\xff" * 3000, 3600), "the compressed data are cut off or damaged"),
    "pcd packed other size": ("c.pcd", compressed(PACKED, 4000), "expected 3600 bytes of points, got 4000"),
    "pcd packed bomb": ("c.pcd", compressed(b"\0a" * 9, 3 * 10**9, 250_000_000), "18 compressed bytes cannot hold"),
    "ply empty": ("c.ply", b"", "c.ply:1: expected the word ply"),
    "ply no end": ("c.ply", b"ply\nformat ascii 1.0\n", "expected a PLY header that ends|header"),
    "ply no format": ("c.ply", b"ply\nelement vertex 3\nend_header\n", "expected the format in the PLY header"),
    "ply odd format": ("c.ply", b"ply\nformat middle_endian 1.0\n", "c.ply:2: expected a line of a PLY header"),
    "ply cut": ("c.ply", ply()[:-1], "expected 3900 bytes for 300 vertices, got 3899"),
    "ply text cut": ("c.ply", ply(text=True)[:-3000], "bytes for 300 vertices|expected 300 vertices|got . words"),
    "ply huge": ("c.ply", ply_head(10**13) + bytes(99), "expected 120000000000000 bytes for 10000000000000 vertices"),
    "ply text huge": ("c.ply", ply_head(10**13, "ascii") + b"1 2 3\n", "for 10000000000000 vertices"),
    "ply odd count": ("c.ply", ply_head("many"), "c.ply:3: expected a line of a PLY header"),
    "ply without z": ("c.ply", ply().replace(b"float z", b"float t"), "expected the properties x y z once each"),
    "ply of lists": ("c.ply", ply_head(9, more="property list uchar int i\n"), "expected vertices before any list"),
    "ply faces alone": ("c.ply", b"ply\nformat ascii 1.0\nelement face 0\nend_header\n", "expected an element vertex"),
    "ply other byte order": ("c.ply", ply_head(300) + SWAPPED, "got numbers as of another byte order"),
    "ply all nan": ("c.ply", ply(NO_POINTS), "got none that is finite"),
    "text empty": ("c.xyz", b"", "expected lines of numbers, got none"),
    "text comments": ("c.xyz", b"# x y z\n", "expected lines of numbers, got none"),
    "text cut": ("c.xyz", b"1 2 3\n4 5 6\n7 8", "c.xyz:3: expected 3 numbers, got 2 words"),
    "text words": ("c.xyz", b"1 2 3\n4 5 six\n", "c.xyz:2: expected numbers, got '4 5 six'"),
    "text binary": ("c.xyz", b"1 2 3\n\xff\xfe\xfd\n", "c.xyz:2: expected numbers as text, got other bytes"),
    "text two columns": ("c.xyz", b"1 2\n3 4\n", "c.xyz:1: expected x y z in every line, got 2 columns"),
    "text miscounted": ("c.pts", b"9\n1 2 3\n", "expected the 9 points that the first line counts, got 1"),
    "text all nan": ("c.xyz", b"nan nan nan\n", "got none that is finite"),
    "kitti cut": ("c.bin", KITTI.tobytes()[:-3], "expected 16 bytes a point, got 4797 bytes"),
    "kitti empty": ("c.bin", b"", "expected at least one point, got none"),
    "kitti other byte order": ("c.bin", KITTI.astype(">f4").tobytes(), "another byte order"),
    "npy empty": ("c.npy", b"", "expected an array in numpy's format"),
    "npy other": ("c.npy", b"not numpy at all" * 9, "expected an array in numpy's format"),
    "npy cut": ("c.npy", npy(POINTS)[:-1], "expected 3600 bytes for an array of shape"),
    "npy huge": ("c.npy", npy_head(10**12) + bytes(100), "expected 24000000000000 bytes for an array of shape"),
    "npy of a name": ("c.npy", npy_head(9).replace(b"False", b"Fals3") + bytes(216), "a file that cannot be read"),
    "npy of objects": ("c.npy", npy(np.array([[1, 2, None]])), "got one of Python objects"),
    "npy of words": ("c.npy", npy(np.array([["a", "b", "c"]])), "expected an array of real numbers, got one of <U1"),
    "npy flat": ("c.npy", npy(np.arange(9.0)), r"expected an array of shape \(N, 3\) or \(S, B, 3\), got \(9,\)"),
    "npy all nan": ("c.npy", npy(NO_POINTS), "got none that is finite"),
    "npz cut": ("c.npz", npz(points=POINTS)[:-40], "expected an array in numpy's format"),
    "npz of several": ("c.npz", npz(a=POINTS, b=POINTS), "expected an array 'points' or only one array, got 'a, b'"),
    "npz bomb": ("c.npz", zip_bomb(), "bytes that grow to 2047 MiB or more: refused"),
    "e57 other": ("c.e57", b"PK\x03\x04" + bytes(99), "expected an E57 file, got one that does not begin like one"),
    "unknown": ("c.doc", b"x", "expected a cloud .*, got the ending '.doc'"),
}


@pytest.mark.parametrize(("name", "data", "sentence"), BAD.values(), ids=BAD)
def test_a_bad_cloud_is_one_sentence(name: str, data: bytes, sentence: str, tmp_path: Path):
    path = tmp_path / f"folder with blanks é {name}"
    path.write_bytes(data)
    with pytest.raises(LogError, match=sentence) as caught:
        read_cloud(path)
    assert str(caught.value).startswith(str(path)) and "\n" not in str(caught.value)
    assert " at 0x" not in str(caught.value)  # the same every time


def test_a_missing_cloud(tmp_path: Path):
    with pytest.raises(LogError, match=r"no\.pcd: expected a file with a cloud, found none"):
        read_cloud(tmp_path / "no.pcd")
    assert is_cloud_file(Path("A.PCD")) and not is_cloud_file(Path("a.clf"))
