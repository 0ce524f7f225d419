"""The page of a run: what it is made of, and that it works in a real browser, from disk, without a network."""

import json
import time
from collections.abc import Iterator
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2
from shapely import LineString, box

from slam.diagnostics.verdict import ranges_of
from slam.evaluation import Metric
from slam.io.trajectories import Trajectory
from slam.map.map_planes import MapPlane
from slam.runs.history import History
from slam.runs.stored_run import StoredRun
from slam.visualization.report import nis_blocks, scene_of, write_report
from spplanes import Plane
from spplanes.spmodel import transform_from_rpy
from tests.slam.visualization.browser import Browser
from tests.slam.visualization.test_open3d_export import moving, wall

EVIL = "</script><script>window.pwned = 1</script><img src=x onerror='window.pwned = 2'>"
#: A pixel of a red dot: pictures are embedded as they are.
PNG = bytes.fromhex(
    "89504e470d0a1a0a0000000d49484452000000010000000108020000009077"
    "53de0000000c4944415408d763f8cfc000000301010018dd8db00000000049454e44ae426082"
)


def stored() -> StoredRun:
    """A wall with a window, a square behind another, a line, two paths, and names that try to get out."""
    upright = transform_from_rpy((0.0, -3.0, 1.0, 0.0, np.pi / 2, 0.0))
    line = replace(wall(8, LineString([(0, 2), (3, 2)]), upright), kinds=(EVIL,))
    across = (transform_from_rpy((x, 0.0, 0.0, 0.0, np.pi / 2, 0.0)) for x in (6.0, 5.0))
    squares = [wall(number, box(-1, -1, 1, 1), frame) for number, frame in enumerate(across, 1)]
    nis = {EVIL: [(k, 3.0, 3) for k in range(30)], "plane": [(k // 3, 2.0 + (k % 5), 3) for k in range(90)]}
    tables = [("the run", [Metric(EVIL, float("nan"), EVIL), Metric("planes", 3, "")])]
    points = wall().plane.frame[:3, 3] + np.random.default_rng(0).normal(0.0, 0.5, (2000, 3))
    return StoredRun(
        Path(), [wall(), line, *squares], moving(30, 0.0), moving(30, 0.5), History(nis=nis, points=points), tables
    )


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("a page with ü & <b>")
    (folder / "map <i>.png").write_bytes(PNG)
    run = stored()
    scene = scene_of(run, run.history, [3, 4, 5, 20, 400])
    write_report(folder / "report.html", EVIL, run.tables, [folder / "map <i>.png"], scene)
    return folder / "report.html"


def test_names_from_files_stay_text(page: Path):
    text = page.read_text(encoding="utf-8")
    parser, elements = HTMLParser(), []
    parser.handle_starttag = lambda tag, attributes: elements.append(tag)
    parser.feed(text)
    assert elements.count("script") == 2  # the scene and the viewer
    assert elements.count("img") == 1
    assert EVIL not in text


def test_doubtful_keyframes_are_stretches_of_the_way():
    assert ranges_of([5, 3, 4, 20, 3]) == [[3, 4, 5], [20]] and ranges_of([]) == []
    run = stored()
    three, one = scene_of(run, run.history, [3, 4, 5, 20, 400])["doubtful"]
    np.testing.assert_allclose(three, run.trajectory.poses[3:6, :3, 3], atol=1e-4)
    assert len(one) == 1


def test_few_measurements_are_spread_one_by_one():
    run = stored()
    history = History(nis={"plane": [(1, 3.0, 3), (1, 6.0, 3), (1, 1.5, 3)]})
    (series,) = scene_of(run, history)["nis"]
    assert (series["over"], series["last"]) == ("measurement", 2)
    assert series["dots"] == [[0, 1.0], [1, 2.0], [2, 0.5]]
    assert [(block["from"], block["to"]) for block in series["blocks"]] == [(0, 2)]
    assert "in the order of their keyframes" in series["caption"]
    assert {one["over"] for one in scene_of(run, run.history)["nis"]} == {"measurement", "keyframe"}


def test_the_scene_holds_the_numbers_of_the_planes():
    run = stored()
    scene = scene_of(run, run.history)
    one = scene["planes"][0]
    assert one["id"] == 7 and one["d"] == wall().plane.d and one["sigma_mm"] == pytest.approx(1.0)
    assert one["tilts_deg"] == pytest.approx(np.rad2deg([2e-3, 3e-3]).tolist())
    assert one["area_m2"] == pytest.approx(7.0)
    (face,) = one["faces"]
    assert [len(ring) for ring in face] == [4, 4]  # the window is a hole
    for point in [*face[0], *face[1], one["inside"]]:
        assert abs(wall().plane.distance(np.array(point))) < 1e-4
    assert scene["planes"][1]["faces"] == [] and len(scene["planes"][1]["segments"]) == 1
    json.dumps(scene, allow_nan=False)


def test_slits_between_patches_are_closed_for_the_eye_and_windows_stay_open():
    patches = box(0, 0, 1, 1).union(box(1.04, 0, 2, 1))
    plane = MapPlane(0, Plane(np.eye(4), np.eye(3) * 1e-6, 10), patches, 1, ())
    run = StoredRun(Path(), [plane, wall()], moving(2, 0.0), moving(2, 0.0), History(), [])
    slit, window = scene_of(run, run.history)["planes"]
    assert len(slit["faces"]) == 1 and slit["area_m2"] == pytest.approx(patches.area)
    assert len(window["faces"][0]) == 2


def test_blocks_of_nis_and_their_bands_by_hand():
    rows = [(k, 6.0 if k < 20 else 1.5, 3) for k in range(40)]
    first, second = nis_blocks(rows)
    assert (first["from"], first["to"], first["mean"]) == (0, 19, 2.0)
    assert (second["from"], second["to"], second["mean"]) == (20, 39, 0.5)
    assert [first["low"], first["high"]] == pytest.approx(chi2.ppf([0.025, 0.975], 60) / 60)
    assert len(nis_blocks(rows[:3])) == 1
    assert len(nis_blocks([(k, 1.0, 2) for k in range(10_000)])) <= 60


# --- in a browser ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    window = Browser(width=1100, height=900, scale=1.5)
    yield window
    window.close()


@pytest.fixture
def opened(browser: Browser, page: Path) -> Browser:
    browser.open(page)
    return browser


#: Number of pixels of the map that something was drawn on.
PAINTED = """
const map = document.getElementById("map");
const data = map.getContext("2d").getImageData(0, 0, map.width, map.height).data;
let painted = 0;
for (let i = 3; i < data.length; i += 4) painted += data[i] > 0;
return painted;
"""
#: A picture of the map after the frame that is due.
PICTURE = "spplanes.draw(); return document.getElementById('map').toDataURL();"


def on_screen(browser: Browser, number: int) -> tuple[float, float]:
    """Where a plane is in the window, px."""
    x, y = browser.run("return spplanes.screenOf(arguments[0])", number)
    left, top = browser.run("const r = document.getElementById('map').getBoundingClientRect(); return [r.left, r.top]")
    return left + x, top + y


def tip(browser: Browser, start: str | None) -> str | None:
    """What the box beside the mouse says, None when it is not there; a move may arrive a frame or two later."""
    script = "const t = document.getElementById('tip'); return t.style.display === 'block' ? t.innerText : null"
    for _ in range(60):
        text = browser.run(script)
        if (text or "").startswith(start or "") and (text is None) == (start is None):
            break
        time.sleep(0.05)
    return text


def test_it_loads_from_disk_without_an_error_or_a_request_and_draws_the_map_and_the_charts(browser, page: Path):
    browser.console()
    browser.open(page)
    assert browser.console() == []
    requests = "performance.getEntriesByType('resource').filter((e) => !e.name.startsWith('data:'))"
    assert browser.run(f"return {requests}") == []
    assert browser.run("return window.pwned ?? null") is None
    assert browser.run("return document.querySelector('h1').innerText") == EVIL
    assert EVIL in browser.run("return document.body.innerText")
    assert browser.run(PAINTED) > 20_000
    assert browser.run("return document.querySelectorAll('canvas.chart').length") == 2
    blank = "const c = document.querySelector('canvas.chart'); const e = document.createElement('canvas');"
    blank += "e.width = c.width; e.height = c.height; return c.toDataURL() === e.toDataURL()"
    assert browser.run(blank) is False


def test_a_plane_answers_with_its_numbers_and_not_through_its_window(opened: Browser):
    opened.point_at(*on_screen(opened, 7))
    text = tip(opened, "plane 7")
    assert text.startswith("plane 7")
    for number in (f"{wall().plane.d:.4f} m", "1.00 mm", "100", "7.00 m²", *[f"{v:.4f}" for v in wall().plane.normal]):
        assert number in text
    opened.point_at(*on_screen(opened, 8))
    assert (tip(opened, "plane 8") or "").startswith("plane 8")  # a line seen by a 2D laser
    opened.point_at(5, 5)
    assert tip(opened, None) is None
    hole = wall().plane.frame[:3, 3].tolist()
    script = "const p = spplanes.project(arguments[0]); return spplanes.planeAt(...p)"
    assert opened.run(script, hole) is None


def test_the_nearer_plane_covers_the_farther_and_backs_are_open(opened: Browser):
    """Two squares at x = 6 and x = 5, facing +x: from there the first, from behind neither, with backs the second."""
    look = "spplanes.look(arguments[0], 0.0); spplanes.draw();"
    centre = "const p = spplanes.project([arguments[1], 0, 0]); const i = spplanes.planeAt(...p); "
    identify = "return i === null ? null : spplanes.idOf(i)"
    assert opened.run(look + centre + identify, 0.0, 6.0) == 1
    assert opened.run(look + centre + identify, np.pi, 5.0) is None
    opened.run("document.getElementById('show-behind').click()")
    assert opened.run(look + centre + identify, np.pi, 5.0) == 2


def test_it_turns_zooms_and_changes_by_mouse_keys_and_boxes(opened: Browser):
    pictures = [opened.run(PICTURE)]

    def changed() -> bool:
        pictures.append(opened.run(PICTURE))
        return pictures[-1] != pictures[-2]

    opened.drag((500, 400), (620, 440))
    assert changed()
    for key in ("ArrowLeft", "+", "1", "2", "0"):
        event = "document.getElementById('map').dispatchEvent(new KeyboardEvent('keydown', {key: arguments[0]}))"
        opened.run(event, key)
        assert changed(), key
    assert pictures[-1] == pictures[0]  # the whole map again
    wheel = "new WheelEvent('wheel', {deltaY: -300, cancelable: true})"
    opened.run(f"document.getElementById('map').dispatchEvent({wheel})")
    assert changed()
    for name in ("show-points", "show-points", "show-planes", "show-planes", "show-odometry", "show-estimate"):
        opened.run("document.getElementById(arguments[0]).click()", name)
        assert changed(), name
    choose = "c.value = 'sigma'; c.dispatchEvent(new Event('change', {bubbles: true}))"
    opened.run(f"const c = document.getElementById('colour'); {choose}")
    assert changed()
    assert "mm" in opened.run("return document.getElementById('legend').innerText")
    assert opened.console() == []


def test_inside_the_map_nothing_behind_the_camera_is_drawn(opened: Browser):
    """What is behind the eye is clipped, not mirrored to the front."""
    opened.run("['show-estimate', 'show-odometry'].forEach((name) => document.getElementById(name).click())")
    away = "Object.assign(spplanes.view, {yaw: 0, pitch: 0, target: [-60, 0, 0], distance: 0.5}); spplanes.draw();"
    assert opened.run(away + "return spplanes.project([5, 0, 0])") is None
    corner = "const c = document.getElementById('map').getContext('2d');"
    corner += "return Array.from(c.getImageData(c.canvas.width / 2, c.canvas.height / 2, 1, 1).data)"
    assert opened.run(corner)[3] == 0  # everything lies at x > -5, behind an eye at -59.5 that looks along -x


def test_a_page_without_planes_has_no_error(browser: Browser, tmp_path: Path):
    run = StoredRun(tmp_path, [], Trajectory.empty(), Trajectory.empty(), History(), [])
    write_report(tmp_path / "report.html", "nothing", [], [], scene_of(run, run.history))
    browser.console()
    browser.open(tmp_path / "report.html")
    assert browser.console() == []
