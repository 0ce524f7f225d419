"""Docs that cannot rot: the Python of every page runs, pages are linked, and the rig's fields are all described."""

import re
from pathlib import Path

import pytest

import factors
import slam
import spplanes
from slam.cli import app
from slam.sensors.rig import LocalisationNoise, Mount, Rig, Sensor
from slam.sensors.wheel_noise import OdometryNoise
from spplanes import __version__

ROOT = Path(__file__).resolve().parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
BLOCK = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\]\(([^)#\s]+)(?:#[^)\s]*)?\)")


def blocks_of(page: Path) -> list[tuple[int, str]]:
    """Line number of the first line, and source, of every Python block of a page."""
    text = page.read_text(encoding="utf-8")
    return [(text.count("\n", 0, match.start(1)) + 1, match.group(1)) for match in BLOCK.finditer(text)]


def test_every_command_of_the_readme_exists():
    commands = re.findall(r"^    spplanes (\w+)", (ROOT / "README.md").read_text(encoding="utf-8"), re.MULTILINE)
    known = {one.name or (one.callback.__name__ if one.callback else "") for one in app.registered_commands}
    assert set(commands) <= known and len(set(commands)) >= 7


def test_every_picture_of_the_gallery_is_made_by_the_tool():
    tool = (ROOT / "tools" / "figures.py").read_text(encoding="utf-8")
    pictures = LINK.findall((ROOT / "docs" / "gallery.md").read_text(encoding="utf-8"))
    assert len(pictures) >= 5 and [name for name in pictures if f'"{Path(name).name}"' not in tool] == []


@pytest.mark.parametrize("page", [page for page in PAGES if blocks_of(page)], ids=lambda page: page.stem)
def test_python_of_a_page_runs(page: Path, tmp_path, monkeypatch):
    """All blocks of a page in one namespace, in an empty folder; line numbers in a traceback are those of the page."""
    monkeypatch.chdir(tmp_path)
    namespace: dict[str, object] = {"__name__": f"docs.{page.stem}"}
    for line, source in blocks_of(page):
        exec(compile("\n" * (line - 1) + source, str(page), "exec"), namespace)  # noqa: S102 - our own pages


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_links_lead_somewhere(page: Path):
    targets = [link for link in LINK.findall(page.read_text(encoding="utf-8")) if "://" not in link]
    assert [target for target in targets if not (page.parent / target).exists()] == []


#: Where docs/rig.md describes what.
SECTIONS = {
    "Top level": Rig,
    "A sensor": Sensor,
    "The mount": Mount,
    "The wheels: `odometry`": OdometryNoise,
    "Poses that a log gives: `localisation`": LocalisationNoise,
}
UNITS = {"m": "m", "rad": "rad", "deg": "deg", "s": "s"}


def rows_of(section: str) -> dict[str, tuple[str, str, str]]:
    """Unit, default and meaning of every key in the table of a section of docs/rig.md."""
    text = (ROOT / "docs" / "rig.md").read_text(encoding="utf-8")
    body = re.split(r"^##+ ", text.split(f"# {section}\n", 1)[1], maxsplit=1, flags=re.MULTILINE)[0]
    rows = re.findall(r"^\| `(\w+)` \|([^|]*)\|([^|]*)\|(.*)\|$", body, re.MULTILINE)
    return {key: (unit.strip(), default.strip(), meaning) for key, unit, default, meaning in rows}


@pytest.mark.parametrize("section", SECTIONS)
def test_the_rig_page_is_the_rig(section: str):
    """Every key, and no other, each with its unit, its default and a meaning."""
    rows, fields = rows_of(section), SECTIONS[section].model_fields
    keys = {field.alias or name: field for name, field in fields.items()}
    assert set(rows) == set(keys)
    for key, (unit, default, meaning) in rows.items():
        assert len(meaning) > 5, key
        suffix = next((end for end in UNITS if key.endswith(f"_{end}") and "_per_" not in key), None)
        if suffix is not None:
            assert unit == UNITS[suffix], key
        if isinstance(keys[key].default, float):
            assert float(default) == keys[key].default, key
        elif keys[key].is_required():
            assert default == "required", key


def test_every_public_name_is_in_the_api_reference():
    text = "".join(page.read_text(encoding="utf-8") for page in (ROOT / "docs" / "api").glob("*.md"))
    modules = set(re.findall(r"automodule:: (\S+)", text))
    names = [(package, name) for package in (spplanes, factors, slam) for name in package.__all__ if name[0] != "_"]
    homes = {(f"{package.__name__}.{name}", getattr(package, name).__module__) for package, name in names}
    assert [name for name, home in homes if home not in modules and f"autofunction:: {name}\n" not in text] == []


def test_the_version_is_the_same_everywhere():
    for name, told in (("CITATION.cff", f"\nversion: {__version__}\n"), ("CHANGELOG.md", __version__)):
        assert told in (ROOT / name).read_text(encoding="utf-8")
