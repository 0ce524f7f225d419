"""Docs that cannot rot: the Python of every page runs, pages are linked, and the rig's fields are all described."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from slam.motion import OdometryNoise
from slam.mount import Mount
from slam.rig import LocalisationNoise, Rig, Sensor
from spplanes import __version__

ROOT = Path(__file__).resolve().parent.parent
PAGES = sorted((ROOT / "docs").glob("*.md"))
BLOCK = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\]\(([^)#\s]+)(?:#[^)\s]*)?\)")


def blocks_of(page: Path) -> list[tuple[int, str]]:
    """Line number of the first line, and source, of every Python block of a page."""
    text = page.read_text(encoding="utf-8")
    return [(text.count("\n", 0, match.start(1)) + 1, match.group(1)) for match in BLOCK.finditer(text)]


def test_there_are_pages_with_code():
    assert {page.stem for page in PAGES if blocks_of(page)} >= {"index", "conventions", "theory", "sensors"}


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


@pytest.mark.parametrize("model", [Rig, Sensor, Mount, OdometryNoise, LocalisationNoise])
def test_every_field_of_a_rig_is_described(model):
    text = (ROOT / "docs" / "sensors.md").read_text(encoding="utf-8")
    keys = [field.alias or name for name, field in model.model_fields.items()]
    assert [key for key in keys if f"| `{key}` |" not in text] == []


def test_defaults_on_the_page_are_those_of_the_code():
    text = (ROOT / "docs" / "sensors.md").read_text(encoding="utf-8")
    rows = {row[0]: row[1] for row in re.findall(r"^\| `(\w+)` \| [^|]* \| ([^|]*) \|", text, re.MULTILINE)}
    for model in (Sensor, OdometryNoise, LocalisationNoise):
        for name, field in model.model_fields.items():
            if isinstance(field.default, float) and name != "heading_sigma_rad":
                assert float(rows[name]) == field.default, name


def test_the_version_is_the_same_everywhere():
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert f"\nversion: {__version__}\n" in citation
    assert __version__ in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
