"""Imports go one way, nothing is imported by its name in a string, and light modules stay light."""

import ast
import os
import subprocess
import sys
import tomllib
from collections import Counter
from functools import cache
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]
PACKAGES = ("express50", "pipelines", "annotations", "grmm")
# The list of all stages: the one file that imports a neighbour package.
STAGE_LIST = REPOSITORY / "pipelines" / "stages.py"
LIGHT = [
    "express50",
    "express50.errors",
    "express50.geometry.shapes",
    "express50.contract.config",
    "express50.contract.layout",
    "express50.geometry.cameras",
    "express50.geometry.transforms",
    "express50.contract.stage",
    "express50.console",
    "express50.__main__",
    "pipelines.stages",
    *(f"pipelines.{path.parent.name}" for path in (REPOSITORY / "pipelines").glob("*/__init__.py")),
]
IMPORTERS = {"import_module", "__import__"}
HEAVY = {"torch", "open3d", "pycolmap", "cv2"}


def module_name(path):
    parts = path.relative_to(REPOSITORY).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def sources():
    for package in PACKAGES:
        yield from sorted((REPOSITORY / package).rglob("*.py"))


MODULES = {module_name(path): path for path in sources()}


@cache
def trees():
    """Every module's syntax tree; parsed by the process that runs the tests, not by all."""
    return {name: ast.parse(path.read_text(encoding="utf-8")) for name, path in MODULES.items()}


@cache
def imports():
    """By module, names of all imported ones, in functions and under TYPE_CHECKING too."""
    return {name: set(imports_of(tree)) for name, tree in trees().items()}


def imports_of(tree):
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            # "from package import module" names a module, "from module import name" does not.
            below = {f"{node.module}.{alias.name}" for alias in node.names}
            yield from below if below <= MODULES.keys() else {node.module}


def docstrings(tree):
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            yield node.value


def strings_of(tree):
    """Strings that are no documentation."""
    documents = set(map(id, docstrings(tree)))
    for node in ast.walk(tree):
        text = node.value if isinstance(node, ast.Constant) and id(node) not in documents else None
        if isinstance(text, str):
            yield text


def names_module(text):
    """Whether a string names one of the project's modules, or an object in one."""
    module = text.partition(":")[0]
    return module in MODULES and "." in module


def test_packages_import_only_the_core():
    wrong = [
        f"{name} imports {other}"
        for name, others in imports().items()
        if MODULES[name] != STAGE_LIST
        for other in sorted(others)
        if other.split(".")[0] in PACKAGES
        and other.split(".")[0] not in ("express50", name.split(".")[0])
    ]
    assert wrong == []


def test_no_module_is_imported_by_its_name_in_a_string():
    calls = [
        name
        for name, tree in trees().items()
        for node in ast.walk(tree)
        if isinstance(node, ast.Call)
        and getattr(node.func, "attr", getattr(node.func, "id", "")) in IMPORTERS
    ]  # fmt: skip
    named = [
        f"{name}: {text!r}" for name, tree in trees().items() for text in strings_of(tree)
        if names_module(text) and text != name.rpartition(".")[0]  # its own folder, for resources
    ]  # fmt: skip
    assert calls == [] and named == []


def test_entry_points_lead_to_objects():
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
    for group in project["entry-points"].values():
        for value in group.values():
            module, _, name = value.partition(":")
            assert hasattr(__import__(module, fromlist=[name]), name), value


def test_no_product_code_imports_tests_or_benchmarks():
    wrong = [
        name for name, others in imports().items()
        if {"tests", "benchmarks"} & {other.split(".")[0] for other in others}
    ]  # fmt: skip
    assert wrong == []


def test_there_is_no_import_cycle():
    edges = {name: (others & set(MODULES)) - {name} for name, others in imports().items()}
    done = set()

    def visit(name, trail):
        assert name not in trail, " -> ".join([*trail[trail.index(name) :], name])
        if name not in done:
            for other in sorted(edges[name]):
                visit(other, [*trail, name])
            done.add(name)

    for name in edges:
        visit(name, [])


def test_a_program_starts_when_its_module_is_complete():
    wrong = [
        name
        for name, tree in trees().items()
        for node in tree.body[:-1]
        if isinstance(node, ast.If) and "__main__" in ast.unparse(node.test)
    ]
    assert wrong == [], "the call of main() comes last"


def test_class_names_are_unique():
    counts = Counter(
        node.name for tree in trees().values() for node in tree.body
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_")
    )  # fmt: skip
    shared = {name for name, count in counts.items() if count > 1}
    assert shared == set(), "give the new class the full word of its field"


@pytest.mark.parametrize("module", LIGHT)
def test_light_modules_import_nothing_heavy(module):
    assert_loads_none(HEAVY, module)


def test_align_and_the_annotator_start_without_torch():
    assert_loads_none({"torch"}, "annotations.align.stage, annotations.ui.session")


def assert_loads_none(heavy, modules):
    code = f"import sys, {modules}; print(sorted({heavy!r} & set(sys.modules)))"
    environment = os.environ | {"PYTHONPATH": str(REPOSITORY)}
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
