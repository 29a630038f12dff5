"""Write one benchmark's section of docs/TRADEOFFS.md; several benchmarks share the page."""

from __future__ import annotations

from pathlib import Path

TITLE = "# Speed against accuracy\n"


def replace_section(path: Path, heading: str, lines: list[str]) -> None:
    """Write a section of second level; the others stay, a new one comes last."""
    text = path.read_text(encoding="utf-8") if path.is_file() else TITLE
    front, *parts = text.split("\n## ")
    sections = dict(part.split("\n", 1) for part in parts)
    sections[heading] = "\n" + "\n".join(lines).strip() + "\n"
    whole = [front.rstrip() + "\n", *(f"## {name}\n{body}" for name, body in sections.items())]
    path.write_text("\n".join(whole), encoding="utf-8")
