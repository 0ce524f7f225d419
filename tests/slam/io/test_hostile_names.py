"""Files that mean harm: names that come out of them lead nowhere, what grows out of proportion is refused."""

import gzip
import io
import json
import re
import struct
import zipfile
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from slam.errors import LogError
from slam.io import raw
from slam.io.carmen import read_carmen
from slam.io.clouds import read_cloud
from slam.io.load import load
from slam.io.raw import check_ratio, read_unpacked
from slam.io.trajectories import read_tum
from slam.runs.history import History
from slam.runs.stored_run import StoredRun
from slam.simulation.record import Truth
from slam.visualization.mesh import write_glb
from slam.visualization.rerun_export import write_rerun
from tests.fuzz.target import NEXT_FILE
from tests.fuzz.targets import TARGETS
from tests.slam.io.bags import write
from tests.slam.io.test_clouds import npy
from tests.slam.io.test_rosbag import mission

NAMES = ("<script>", "../x", "/tmp/x", "a\nb\x1b[31m\0c", "n" * 10_000, "..", "C:\\x", "\u202e")


def _npz(*members: tuple[str, np.ndarray]) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name, values in members:
            archive.writestr(zipfile.ZipInfo(name), npy(values))
    return stream.getvalue()


def _unfolded(folder: Path, target: str, *names: str) -> Path:
    """Files of a valid input of a fuzz target."""
    folder.mkdir()
    for name, content in zip(names, TARGETS[target].seeds()[0].split(NEXT_FILE), strict=False):
        (folder / name).write_bytes(content)
    return folder


def _files_about(folder: Path) -> list[str]:
    return sorted(str(one.relative_to(folder.parent)) for one in folder.parent.rglob("*"))


@pytest.mark.parametrize("name", NAMES, ids=ascii)
def test_members_of_an_archive_are_read_where_they_are(name: str, tmp_path: Path):
    """None is unpacked, so none can leave; one is taken for what it holds, several are told by names one can read."""
    inside = tmp_path / "inside"
    inside.mkdir()
    points, one, two = np.ones((4, 3)), inside / "one.npz", inside / "two.npz"
    one.write_bytes(_npz((f"{name}.npy", points)))
    two.write_bytes(_npz((f"{name}.npy", points), ("other.npy", points)))
    before = _files_about(inside)
    assert read_cloud(one).points.shape == (4, 3)
    with pytest.raises(LogError, match="expected an array 'points' or only one array") as error:
        read_cloud(two)
    assert str(error.value).isprintable() and len(error.value.problem) < 200
    assert _files_about(inside) == before


@pytest.mark.parametrize("where", ["..", "/", "file:"])
def test_a_bag_is_read_from_its_own_folder(where: str, tmp_path: Path):
    """The list of a bag's files names one outside of it: a whole one, which is left alone all the same."""
    pytest.importorskip("rosbags")
    folder = write(tmp_path, "sqlite3", lambda messages: islice(mission(messages, columns=8), 5))
    outside = (folder / "run 1 ü.db3").rename(tmp_path / "outside.db3")
    named = {"..": "../outside.db3", "/": str(outside), "file:": f"file:{outside}"}[where]
    metadata = folder / "metadata.yaml"
    text = metadata.read_text(encoding="utf-8")
    assert "run 1 ü.db3" in text
    metadata.write_text(re.sub(r"run 1 (ü|\\xFC)\.db3", named, text), encoding="utf-8")
    with pytest.raises(LogError, match=r"files are missing|cannot be read"):
        load(folder)


@pytest.mark.parametrize("name", NAMES, ids=ascii)
def test_labels_of_a_sensor_of_any_name_are_read_where_they_are(name: str, tmp_path: Path):
    folder = _unfolded(tmp_path / "truth", "truth", "planes.json", "trajectory.tum")
    (folder / "labels.npz").write_bytes(_npz((f"{name}.npy", np.zeros((2, 3), dtype=np.int32))))
    before = _files_about(folder)
    assert len(Truth.read(folder).labels) == 1
    assert _files_about(folder) == before


@pytest.mark.parametrize("name", NAMES, ids=ascii)
def test_kinds_of_factors_of_any_name_are_exported(name: str, tmp_path: Path):
    pytest.importorskip("rerun")
    folder = _unfolded(tmp_path / "run", "run", "planes.json", "trajectory.tum")
    History(nis={name: [(0, 1.5, 3)]}, kinds={0: (name,)}).write(folder / "view.json")
    run = StoredRun.read(folder)
    assert list(run.history.nis) == [name]
    before = _files_about(folder)
    write_rerun(run, folder / "run.rrd")
    write_glb(folder / "map.glb", [replace(run.planes[0], kinds=(name,))])
    assert sorted({*_files_about(folder)} - {*before}) == ["run/map.glb", "run/run.rrd"]
    data = (folder / "map.glb").read_bytes()
    (size,) = struct.unpack_from("<I", data, 12)
    assert [node["name"] for node in json.loads(data[20 : 20 + size])["nodes"]][:2] == ["map", "plane 0"]


@pytest.fixture
def small_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    """64 MiB take seconds to make."""
    monkeypatch.setattr(raw, "HARMLESS_BYTES", 1 << 18)


def bomb(path: Path, line: bytes) -> Path:
    path.write_bytes(gzip.compress(line * ((1 << 20) // len(line)), compresslevel=9))
    assert path.stat().st_size * raw.MOST_GROWTH < 1 << 20
    return path


BOMBS = {
    "log.clf.gz": b"# nothing at all\n",
    "blank.clf.gz": b"\n",
    "Größe 1.log.gz": b"PARAM a_very_long_parameter 1 \n",
    "scan000.3d.gz": b"1 2 3\n",
    "poses.tum.gz": b"# 1 2 3 4 5 6 7 8\n",
}


@pytest.mark.parametrize("name", BOMBS)
def test_a_bomb_is_refused_while_it_unpacks(name: str, tmp_path: Path, small_limit: None):
    path = bomb(tmp_path / name, BOMBS[name])
    read = read_unpacked if "3d" in name else read_tum if "tum" in name else read_carmen
    with pytest.raises(LogError, match=r"expected sensor data, got \d+ bytes that grow to 0 MiB or more: refused"):
        read(path)


def test_what_grows_as_logs_do_passes():
    check_ratio(Path("x"), raw.HARMLESS_BYTES, 1)
    check_ratio(Path("x"), 10 * raw.HARMLESS_BYTES, raw.HARMLESS_BYTES)
    with pytest.raises(LogError, match=r"got 1000 bytes that grow to 640 MiB"):
        check_ratio(Path("x"), 10 * raw.HARMLESS_BYTES, 1000)


NO_LOGS = {
    "a cloud": ("one.ply", b"ply\n", "expected a log, got one cloud: give it to `spplanes fit`"),
    "a picture": ("a.png", b"\x89PNG", "expected a log, got one cloud|expected a CARMEN record"),
    "an empty file": ("empty.clf", b"", "expected a CARMEN log with laser records, got none"),
    "binary": ("x.clf", bytes(range(256)) * 9, "expected"),
}


@pytest.mark.parametrize(("name", "data", "sentence"), NO_LOGS.values(), ids=NO_LOGS)
def test_what_is_no_log(name: str, data: bytes, sentence: str, tmp_path: Path):
    (tmp_path / name).write_bytes(data)
    with pytest.raises(LogError, match=sentence):
        load(tmp_path / name)


def test_the_folder_of_a_run_is_no_log(tmp_path: Path):
    (tmp_path / "planes.json").write_text("{}")
    (tmp_path / "map.ply").write_text("ply\n")
    with pytest.raises(LogError, match="expected a log, got the folder of a run"):
        load(tmp_path)
