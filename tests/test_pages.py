"""Pages that are generated from the code are up to date, and links in the docs lead somewhere."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]
PAGES = [REPOSITORY / "README.md", *sorted((REPOSITORY / "docs").glob("*.md"))]


def test_generated_pages_match_the_code():
    command = [sys.executable, str(REPOSITORY / "scripts" / "write_pages.py"), "--check"]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_and_mentioned_files_exist(page):
    text = page.read_text(encoding="utf-8")
    linked = re.findall(r"\]\(([^)#:]+)\)", text)
    assert [link for link in linked if not (page.parent / link).exists()] == []
    mentioned = re.findall(
        r"\b(?:express50|pipelines|annotations|grmm|benchmarks|tests|docs|scripts)/[\w/]+\.(?:py|md|h|json|toml)\b",
        text,
    )
    assert sorted({path for path in mentioned if not (REPOSITORY / path).exists()}) == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_files_define_the_names_that_pages_look_for_in_them(page):
    named = r"`(\w+)`(?: and `(\w+)`)? in `([\w/]+\.(?:py|h|js))`"
    for *names, path in re.findall(named, page.read_text(encoding="utf-8")):
        code = (REPOSITORY / path).read_text(encoding="utf-8")
        assert [name for name in names if name not in code] == [], path


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_to_headings_lead_to_headings(page):
    links = re.findall(r"\]\(([^)#:]*)#([^)]+)\)", page.read_text(encoding="utf-8"))
    lost = [
        (file, heading)
        for file, heading in links
        if heading not in headings((page.parent / file) if file else page)
    ]
    assert lost == []


def headings(page):
    """Return the anchors of a page's headings, as GitHub makes them."""
    titles = re.findall(r"(?m)^#+ (.+)$", page.read_text(encoding="utf-8"))
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


def test_the_readme_is_short():
    assert len((REPOSITORY / "README.md").read_text(encoding="utf-8").splitlines()) <= 150
