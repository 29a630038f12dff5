"""Write the parts of docs/ that are generated from the code: the main path and the settings.

python scripts/write_pages.py           # rewrites CONFIG.md, lists in ARCHITECTURE.md and PAPER.md
python scripts/write_pages.py --check   # exits with 1 if they differ from the code
"""

from __future__ import annotations

import argparse
import ast
import dataclasses
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

PACKAGES = ("express50", "pipelines", "annotations", "grmm")
DEVIATIONS = "<!-- deviations -->\n"
BEGIN, END = "<!-- main path: begin -->\n", "<!-- main path: end -->\n"


def import_graph() -> dict[str, set[str]]:
    """Map each of the product's modules to those it imports, inside functions too."""
    paths = {
        ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
        for package in PACKAGES
        for path in sorted((ROOT / package).rglob("*.py"))
    }
    graph = {}
    for name, path in paths.items():
        found: set[str] = set()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                found |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                found |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
        graph[name] = (found & set(paths)) - {name}
    return graph


def main_path() -> str:
    """List the files that a frame passes: the core, then the new files of each step."""
    from pipelines.stages import STAGES

    graph = import_graph()
    steps = [(stage.name, stage.run.__module__) for stage in STAGES]
    steps += [("train", "grmm.train"), ("render", "grmm.render")]
    seen: set[str] = set()
    groups: dict[str, list[str]] = {"core": []}
    for title, start in steps:
        todo, new = [start], []
        while todo:
            module = todo.pop()
            if module in seen:
                continue
            seen.add(module)
            new.append(module)
            todo += graph[module]
        groups["core"] += [m for m in new if m.startswith("express50.")]
        groups[title] = [m for m in new if not m.startswith("express50.")]
    lines = ["```"]
    for title, modules in groups.items():
        folders: dict[str, list[str]] = {}
        for module in sorted(modules):
            path = ROOT / (module.replace(".", "/") + ".py")
            if path.is_file():
                folder = path.relative_to(ROOT).parent.as_posix()
                folders.setdefault(folder, []).append(path.stem)
        lines += [title] if folders else []
        lines += [f"  {folder}: {' '.join(names)}" for folder, names in folders.items()]
    return "\n".join([*lines, "```", ""])


def architecture() -> str:
    """Return docs/ARCHITECTURE.md with the list of files as the code has it."""
    text = (ROOT / "docs" / "ARCHITECTURE.md").read_text(encoding="utf-8")
    before, rest = text.split(BEGIN)
    _, after = rest.split(END)
    return f"{before}{BEGIN}{main_path()}{END}{after}"


def paper() -> str:
    """Return docs/PAPER.md with the deviations as the code has them."""
    from grmm.config import PRESETS, resolve
    from grmm.deviations import SMALLER, paper_diff

    text = (ROOT / "docs" / "PAPER.md").read_text(encoding="utf-8")
    before, _, after = text.split(DEVIATIONS)
    lines = paper_diff(resolve("paper-plus"))
    cut = lines.index("With all settings:")
    for name in PRESETS:
        if name not in ("paper", "paper-plus"):
            known = set(lines[:cut])
            own = [line for line in paper_diff(resolve(name)) if line.startswith("| `")]
            own = [line for line in own if line not in known and SMALLER[0] not in line]
            lines += ["", f"`{name}` also, besides sizes and rates:", "", *lines[:2], *own]
    return DEVIATIONS.join([before, "\n".join([*lines, ""]), after])


def field_notes(config: type) -> dict[str, str]:
    """Return the string under each field of a config class."""
    import inspect
    import textwrap

    body = ast.parse(textwrap.dedent(inspect.getsource(config))).body[0]
    assert isinstance(body, ast.ClassDef)
    notes = {}
    for node, after in zip(body.body, [*body.body[1:], None], strict=True):
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            is_note = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
            notes[node.target.id] = " ".join(str(after.value.value).split()) if is_note else ""
    return notes


def settings_table(config: type, presets: dict[str, dict[str, object]]) -> list[str]:
    """Return a table of a config's fields: default, other presets' values, meaning."""
    if not dataclasses.fields(config):
        return ["It has no settings."]
    notes = field_notes(config)
    rows = ["| setting | default | presets | meaning |", "|---|---|---|---|"]
    for field in dataclasses.fields(config):
        default = field.default
        if default is dataclasses.MISSING and field.default_factory is not dataclasses.MISSING:
            default = field.default_factory()
        others = ", ".join(
            f"{name} {values[field.name]!r}"
            for name, values in presets.items()
            if field.name in values
        )
        meaning = notes.get(field.name, "").replace("|", "\\|")
        shown = "required" if default is dataclasses.MISSING else f"`{default!r}`"
        rows.append(f"| `{field.name}` | {shown} | {others} | {meaning} |")
    return rows


def settings() -> str:
    """Return docs/CONFIG.md."""
    import grmm.config
    from pipelines.stages import STAGES

    lines = [
        "# Settings",
        "",
        "Every setting of the stages and of GRMM: its default, other presets' values, its meaning."
        " Generated by `python scripts/write_pages.py`; do not edit.",
        "",
        "Set one with `--set stage.name=value`, several in a TOML file with one table per stage"
        " (`--config`), or take a preset (`--preset draft`, `standard` or `reference`). Command"
        " line beats file, file beats preset.",
    ]
    for stage in STAGES:
        lines += ["", f"## {stage.name}", "", stage.purpose, ""]
        presets = {name: values for name, values in stage.presets.items() if values}
        lines += settings_table(stage.config, presets)
    note = "The defaults are the preset `paper`; `grmm config --preset NAME` prints another one."
    lines += ["", "# Settings of GRMM", "", note]
    for table in dataclasses.fields(grmm.config.Config):
        config = type(getattr(grmm.config.Config(), table.name))
        presets = {name: values.get(table.name, {}) for name, values in grmm.config.PRESETS.items()}
        lines += ["", f"## {table.name}", "", *settings_table(config, presets)]
    return "\n".join([*lines, ""])


def main() -> int:
    """Write the pages, or compare them with the code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--check", action="store_true", help="write nothing; exit with 1 if stale")
    args = parser.parse_args()
    stale = []
    pages = {"ARCHITECTURE.md": architecture, "CONFIG.md": settings, "PAPER.md": paper}
    for name, make in pages.items():
        text = make()
        path = ROOT / "docs" / name
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            stale.append(name)
            if not args.check:
                path.write_text(text, encoding="utf-8")
    print(f"{'stale' if args.check else 'written'}: {', '.join(stale) or 'nothing'}")
    return 1 if args.check and stale else 0


if __name__ == "__main__":
    sys.exit(main())
