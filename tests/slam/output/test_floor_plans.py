"""Floor plans as DXF, SVG and IFC, read back; and from the folder of a run."""

import json
import re
import sys
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from benchmarks.corpus.suite import Suite
from slam.errors import LogError, MissingPackageError
from slam.floorplan import FloorPlan, floor_plan
from slam.io.g2o.reader import read_g2o
from slam.io.trajectories import read_kitti, read_tum
from slam.output.export import check_target, export_run
from slam.output.plan_bim import MEASURED, write_dxf, write_ifc
from slam.output.plan_drawing import write_svg
from slam.output.run_files import write_ply
from slam.runs.stored_run import StoredRun, levelled, stored_floor_plan
from slam.simulation import Mission
from slam.simulation.record import Plan, record
from slam.simulation.robots import spinning_rig
from slam.visualization.mesh import mesh_of
from tests.slam.commands import command, refused, simulated_run
from tests.slam.floorplan.buildings import joint_of, planes_of

SPACING_M = 0.8


@pytest.fixture(scope="module")
def plan() -> FloorPlan:
    """Two storeys."""
    return floor_plan(joint_of(planes_of() + planes_of(floor_m=3.0)))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run of a robot through a corridor and two rooms."""
    folder, suite = tmp_path_factory.mktemp("suite"), Suite.drawn(np.random.default_rng(1), rooms_a_side=1)
    way = suite.path()
    log, truth = record(Plan("suite", suite.world(), way, spinning_rig(), SPACING_M), int(way.length_m / SPACING_M), 1)
    Mission(log, spinning_rig(), truth).save(folder / "log")
    assert command("slam", folder / "log", "--out", folder / "run") == 0
    return folder / "run"


def texts(plan: FloorPlan) -> list[str]:
    """Everything measured that stands in a drawing."""
    found = []
    for storey in plan.storeys:
        for room in storey.rooms:
            found += [str(w.distance) for w in room.widths] + [str(s.length) for ring in room.rings for s in ring]
            found += [f"{room.area} m2", f"height {room.height} m"]
        found += [str(wall.thickness) for wall in storey.walls]
        found += [str(opening.width) for opening in storey.openings]
        found += [f"lintel {opening.height}" for opening in storey.openings]
    return found


def shoelace(points: np.ndarray) -> float:
    return 0.5 * abs(sum(a[0] * b[1] - a[1] * b[0] for a, b in pairwise([*points, points[0]])))


def test_a_dxf(plan: FloorPlan, tmp_path: Path):
    ezdxf = pytest.importorskip("ezdxf")
    for name in ("one.dxf", "other.dxf"):
        write_dxf(tmp_path / name, plan)
    assert (tmp_path / "one.dxf").read_bytes() == (tmp_path / "other.dxf").read_bytes()
    classes = re.findall(r"^CLASS\n  1\n(\w+)$", (tmp_path / "one.dxf").read_text(encoding="utf-8"), re.MULTILINE)
    assert len(classes) > 10 and classes == sorted(classes)  # the same in other processes
    drawing = ezdxf.readfile(tmp_path / "one.dxf")
    audit = drawing.audit()
    assert (audit.errors, audit.fixes) == ([], [])
    space = drawing.modelspace()
    for number, height in ((0, 0.0), (1, 3.0)):
        rooms = space.query(f"LWPOLYLINE[layer=='S{number}-ROOM']")
        assert all(one.closed and one.dxf.elevation == pytest.approx(height) for one in rooms)
        assert sorted(shoelace(one.get_points("xy")) for one in rooms) == pytest.approx([12.0, 12.0, 17.5])
        walls = space.query(f"LWPOLYLINE[layer=='S{number}-WALL']")
        solid = sum(shoelace(one.get_points("xy")) for one in walls)
        assert solid == pytest.approx(0.2 * (4.0 - 0.9 + 5.0 - 1.0), abs=1e-6)
        for one in space.query(f"DIMENSION[layer=='S{number}-DIMENSION']"):
            measured = float(one.dxf.text.split(" +- ")[0])
            assert one.dxf.defpoint2.distance(one.dxf.defpoint3) == pytest.approx(measured, abs=6e-4)
            assert (one.dxf.defpoint2.z, one.dxf.defpoint3.z) == pytest.approx((height, height))
    written = [one.text if one.dxftype() == "MTEXT" else one.dxf.text for one in space.query("TEXT MTEXT DIMENSION")]
    assert all(text in "\n".join(written) for text in texts(plan))


def test_an_svg(plan: FloorPlan, tmp_path: Path):
    write_svg(tmp_path / "plan.svg", plan, "broken")
    root = ElementTree.parse(tmp_path / "plan.svg").getroot()
    space = "{http://www.w3.org/2000/svg}"
    storeys = root.findall(f"{space}g")
    assert [float(one.attrib["data-elevation"]) for one in storeys] == pytest.approx([0.0, 3.0])
    for storey in storeys:
        paths = [one.attrib["d"] for one in storey.findall(f"{space}path") if one.attrib["class"] == "room"]
        areas = [shoelace(np.array(re.findall(r"(-?[\d.]+) (-?[\d.]+)", d), dtype=float)) / 400.0 for d in paths]
        assert sorted(areas) == pytest.approx([12.0, 12.0, 17.5], abs=1e-3)  # 20 mm are 1 m
    written = "\n".join(one.text or "" for one in root.iter(f"{space}text"))
    assert all(text in written for text in texts(plan))
    assert written.count("the run calls its map broken") == 2


def test_an_ifc_is_valid_and_has_the_volumes_and_every_value_with_its_standard_deviation(plan, tmp_path: Path):
    ifc = pytest.importorskip("ifcopenshell")
    from ifcopenshell import geom, validate
    from ifcopenshell.util import shape
    from ifcopenshell.util.element import get_pset

    for name in ("one.ifc", "other.ifc"):
        write_ifc(tmp_path / name, plan)
    assert (tmp_path / "one.ifc").read_bytes() == (tmp_path / "other.ifc").read_bytes()
    building, logger, by_name = ifc.open(tmp_path / "one.ifc"), validate.json_logger(), {}
    validate.validate(building, logger)
    assert logger.statements == []

    def volumes(things) -> list[float]:
        return [shape.get_volume(geom.create_shape(geom.settings(), one).geometry) for one in things]

    assert sorted(volumes(building.by_type("IfcSpace"))) == pytest.approx([30.0] * 4 + [43.75] * 2)
    solid = [one for one in building.by_type("IfcWall") if one.PredefinedType == "SOLIDWALL"]
    assert sorted(volumes(solid[:2])) == pytest.approx([0.2 * (4.0 * 2.5 - 0.9 * 2.05), 0.2 * (5.0 * 2.5 - 1.0 * 2.05)])
    assert [one.Elevation for one in building.by_type("IfcBuildingStorey")] == pytest.approx([0.0, 3.0])
    for one in building.by_type("IfcObject"):
        if values := get_pset(one, MEASURED):
            by_name[one.Name] = {name: value for name, value in values.items() if name != "id"}
    for number, storey in enumerate(plan.storeys):
        for k, room in enumerate(storey.rooms):
            read = by_name[f"storey {number}/room {k + 1}"]
            measures = {"NetFloorArea": room.area, "Width2": room.widths[1].distance, "Height": room.height}
            for name, measure in measures.items():
                told = read[name], read[f"{name}StandardDeviation"]
                assert measure is not None and told == pytest.approx((measure.value, measure.sigma), rel=1e-12)
        for k, wall in enumerate(storey.walls):
            read = by_name[f"storey {number}/wall {k + 1}"]
            assert read.pop("OtherSideSeen") is True
            told = {"Thickness": wall.thickness.value, "ThicknessStandardDeviation": wall.thickness.sigma}
            assert read == pytest.approx(told)
        assert len([name for name in by_name if name.startswith(f"storey {number}/opening")]) == 2
    upper = plan.storeys[1].elevation
    assert upper is not None and by_name["storey 1"]["ElevationStandardDeviation"] == pytest.approx(upper.sigma)


@pytest.mark.parametrize(
    ("write", "package", "name"), [(write_dxf, "ezdxf", "plan.dxf"), (write_ifc, "ifcopenshell", "plan.ifc")]
)
def test_a_package_that_is_missing_is_named(write, package, name, plan: FloorPlan, tmp_path: Path, monkeypatch):
    for module in [module for module in sys.modules if module.split(".")[0] == package]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(MissingPackageError, match=rf"needs {package}: pip install 'spplanes\[bim\]'"):
        write(tmp_path / "plan", plan)
    monkeypatch.setattr("slam.output.export.find_spec", lambda _: None)
    with pytest.raises(MissingPackageError, match=f"{name}: writing this needs"):
        check_target(tmp_path / name, overwrite=False)


def test_a_plan_without_rooms_says_so_once(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    corridor = simulated_run(tmp_path, "corridor", 40, 3)
    capsys.readouterr()
    assert command("export", corridor, "--to", tmp_path / "a.svg", "--to", tmp_path / "b.svg") == 0
    sentence = "the floor plan has no rooms: none was seen all round, only walls and openings are drawn"
    assert capsys.readouterr().err == f"warning: {sentence}\n"
    assert export_run(corridor, tmp_path / "c.svg") == [sentence]
    assert command("export", run, "--to", tmp_path / "rooms.svg") == 0
    assert capsys.readouterr().err == ""


def test_a_run_is_exported_level(run: Path, tmp_path: Path):
    names = ("way.tum", "way.kitti", "graph.g2o", "planes.ply", "plan.svg")
    assert command("export", run, "--level", *[word for one in names for word in ("--to", tmp_path / one)]) == 0
    given, level = StoredRun.read(run), levelled(StoredRun.read(run))
    turn = level.moved_by
    assert turn is not None and 1e-7 < np.abs(turn - np.eye(4)).max() < 0.01
    poses = read_tum(tmp_path / "way.tum").poses
    np.testing.assert_allclose(poses, turn @ given.trajectory.poses, atol=1e-12)
    np.testing.assert_allclose(read_kitti(tmp_path / "way.kitti"), poses, atol=1e-12)
    before, after = read_g2o(run / "graph.g2o"), read_g2o(tmp_path / "graph.g2o")
    assert after.graph.error(after.values) == pytest.approx(before.graph.error(before.values), rel=1e-6)
    normals = [after.values.atOrientedPlane3(key).normal().point3()[2] for key in after.planes.values()]
    assert max(normals) > 1.0 - 1e-12 and before.planes.keys() == after.planes.keys()
    write_ply(tmp_path / "expected.ply", mesh_of(level.planes))
    assert (tmp_path / "planes.ply").read_bytes() == (tmp_path / "expected.ply").read_bytes()
    export_run(run, tmp_path / "as_it_was.svg")
    assert (tmp_path / "plan.svg").read_bytes() == (tmp_path / "as_it_was.svg").read_bytes()


def test_the_plan_of_a_run_is_that_of_its_planes(run: Path):
    stored = StoredRun.read(run)
    plan = stored_floor_plan(stored)
    suite = Suite.drawn(np.random.default_rng(1), rooms_a_side=1)
    true = sorted(room.area_m2 for room in (suite.corridor, *suite.rooms))
    assert sorted(room.area.value for room in plan.storeys[0].rooms) == pytest.approx(true, abs=0.01)
    assert [one.id for one in plan.joint.planes] == [one.id for one in stored.planes]


def test_a_run_without_session_says_so_and_planes_that_are_not_the_session_s_are_refused(run, tmp_path: Path, capsys):
    (other := tmp_path / "other").mkdir()
    for name in ("planes.json", "trajectory.tum", "metrics.json"):
        (other / name).write_bytes((run / name).read_bytes())
    said = refused(capsys, "export", other, "--to", tmp_path / "plan.svg")
    assert "expected a run with its session.db, from which the joint covariance" in said
    assert not (tmp_path / "plan.svg").exists()
    (other / "session.db").write_bytes((run / "session.db").read_bytes())
    planes = json.loads((run / "planes.json").read_text())
    planes["planes"] = planes["planes"][1:]
    (other / "planes.json").write_text(json.dumps(planes))
    with pytest.raises(LogError, match=r"expected a session that leads to the run's planes.json, got other planes"):
        stored_floor_plan(StoredRun.read(other))
