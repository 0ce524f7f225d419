"""Fleets on Dask: the same bits on any number of workers, workers that die, logs that nobody can read."""

import json
import os
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.corpus.drives import make_drive
from slam.config import SlamConfig
from slam.fleet import RECORD_FILE, Order, map_log, open_mapped
from slam.io.carmen import write_carmen
from slam.joining.mission import FinishedMission, Mission, RecordError
from slam.sensors.rig import Rig
from slam.session._codec import encode
from slam.session._file import digest
from tests.slam.commands import assert_same_files, refused, run
from tests.slam.joining.missions import LEVEL, first, office

distributed = pytest.importorskip("distributed")


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two visits of one office as CARMEN logs, short ones of every second scan, with their rig beside."""
    folder, found = tmp_path_factory.mktemp("logs"), []
    for number, part in enumerate(((0.0, 0.3), (0.1, 0.4))):
        drive = make_drive(replace(LEVEL, disturbance="half"), 0, visit=number, part=part)
        found.append(folder / f"visit{number}.clf")
        write_carmen(drive.log, drive.rig, found[-1])
        drive.rig.to_yaml(folder / "rig.yaml")
    return found


def order_of(log: Path, store: Path, **more: object) -> Order:
    return replace(Order(log.stem, log, Rig.from_yaml(log.parent / "rig.yaml"), SlamConfig(), store), **more)


def numbers_of(mission: Mission) -> bytes:
    """All that a mission is, but for its name, bit for bit."""
    looks = [[one.mission_T_body, one.returns, list(one.planes), one.body_T_sensor] for one in mission.looks]
    path = mission.trajectory
    return encode([list(mission.planes), mission.covariance, path.stamps_ns, path.poses, looks])


def test_records_of_missions_come_back():
    for finished in (first(0), office(0, 0)):
        again = FinishedMission.from_bytes(finished.to_bytes())
        assert numbers_of(again.mission) == numbers_of(finished.mission)
        one, other = finished.graph, again.graph
        assert (one.planes, one.carriers) == (other.planes, other.carriers)
        assert other.factors.size() == one.factors.size()
        np.testing.assert_allclose(other.factors.error(other.values), one.factors.error(one.values), rtol=1e-9)


def test_records_that_are_none_are_refused():
    data = first(0).to_bytes()
    with pytest.raises(RecordError, match="expected a record of this version"):
        FinishedMission.from_bytes(b"something else")
    with pytest.raises(RecordError, match="damaged"):
        FinishedMission.from_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    content = encode({"mission": {}})
    with pytest.raises(RecordError, match="with its graph"):
        FinishedMission.from_bytes(data[: data.index(b"\n") + 1] + digest(content) + content)


def test_a_mission_is_mapped_once_whatever_its_name_and_again_where_it_was_left_broken(logs, tmp_path: Path):
    done = map_log(order_of(logs[0], tmp_path))
    assert done.folder is not None and done.mission is not None
    record = Path(done.folder) / RECORD_FILE
    before, again = record.stat().st_mtime_ns, map_log(order_of(logs[0], tmp_path, name="another"))
    assert (again.folder, record.stat().st_mtime_ns) == (done.folder, before)
    assert open_mapped(done.folder, "another").mission.name == "another"
    other = SlamConfig().model_copy(update={"backend": SlamConfig().backend.model_copy(update={"robust": "huber"})})
    assert order_of(logs[0], tmp_path, config=other).key() != record.parent.name
    assert sorted(path.name for path in tmp_path.iterdir()) == [record.parent.name]  # nothing half-made is left
    good = record.read_bytes()
    record.write_bytes(good[: len(good) // 2])
    again = map_log(order_of(logs[0], tmp_path))
    assert again.mission is not None
    assert numbers_of(again.mission) == numbers_of(done.mission) and record.read_bytes() == good


def test_a_fleet_is_the_same_on_one_worker_and_on_two_of_which_one_is_killed(
    logs: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """Bit for bit; and a log that no reader takes is named and left out."""
    broken, rig = tmp_path / "broken.clf", logs[0].parent / "rig.yaml"
    broken.write_text("nothing of a log\n", encoding="utf-8")
    code, _, told = run(capsys, "fleet", *logs[:2], broken, "--rig", rig, "--workers", 1, "--out", tmp_path / "one")
    assert code == 0 and "warning: broken: left out: " in told, told
    joins = json.loads((tmp_path / "one" / "joins.json").read_text(encoding="utf-8"))
    assert joins["components"][0]["missions"] == sorted(joins["runs"]) == ["visit0", "visit1"]

    from slam.fleet import run as run_fleet
    from slam.output.joined_folder import write_joined

    killed: list[int] = []
    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster,
        distributed.Client(cluster, set_as_default=False) as client,
    ):

        def kill(what: str, done: int, total: int) -> None:
            if what == "missions" and not killed:
                killed.append(cluster.workers[sorted(cluster.workers)[done % 2]].pid)
                os.kill(killed[0], signal.SIGKILL)

        store = tmp_path / "two.missions"
        joined = run_fleet([*logs[:2], broken], store, client=client, rig=Rig.from_yaml(rig), progress=kill)
    assert len(killed) == 1
    two = tmp_path / "two"
    two.mkdir()
    write_joined(joined, two, title="spplanes one")
    names = ("planes.json", "trajectory.tum", "trajectories/visit1.tum", "graph.g2o", "map.ply")
    assert_same_files(two, tmp_path / "one", names)

    code, _, told = run(capsys, "fleet", *logs[:2], "--out", tmp_path / "one", "--resume")
    assert (code, "finished already" in told) == (0, True)


def test_bad_input_is_one_sentence(logs: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    out = tmp_path / "map"
    both = ("--scheduler", "tcp://127.0.0.1:1", "--scheduler-file", tmp_path / "none.json")
    assert "one cluster" in refused(capsys, "fleet", *logs, "--out", out, *both)
    assert "found nothing" in refused(capsys, "fleet", *logs, "--out", out, *both[2:])
    assert "workers of its own" in refused(capsys, "fleet", *logs, "--out", out, *both[:2], "--workers", 2)
    assert not out.exists()
