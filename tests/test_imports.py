"""Imports go one way, and the light modules stay light."""

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]
PACKAGES = ("express50", "pipelines", "annotations", "grmm")
# The one file that may name the others; it imports them when their command is asked for.
FRONT = REPOSITORY / "express50" / "cli" / "main.py"
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
]
HEAVY = {"torch", "open3d", "pycolmap", "cv2"}


def imported_packages(path):
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name.split(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            yield node.module.split(".")[0]


def sources():
    for package in PACKAGES:
        yield from sorted((REPOSITORY / package).rglob("*.py"))


def test_packages_import_only_the_core():
    wrong = [
        f"{path.relative_to(REPOSITORY)} imports {name}"
        for path in sources()
        if path != FRONT
        for name in imported_packages(path)
        if name in PACKAGES and name not in ("express50", path.relative_to(REPOSITORY).parts[0])
    ]
    assert wrong == []


def test_no_product_code_imports_tests_or_benchmarks():
    wrong = [p for p in sources() if {"tests", "benchmarks"} & set(imported_packages(p))]
    assert wrong == []


def module_imports():
    """Imports among the project's modules that run when a module is loaded."""
    graph = {}
    for path in sources():
        parts = path.relative_to(REPOSITORY).with_suffix("").parts
        name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        graph[name] = path
    edges = {}
    for name, path in graph.items():
        found = set()
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ImportFrom) and node.module:
                named = {f"{node.module}.{alias.name}" for alias in node.names}
                found |= named if named <= set(graph) else {node.module}
            elif isinstance(node, ast.Import):
                found |= {alias.name for alias in node.names}
        edges[name] = (found & set(graph)) - {name}
    return edges


def test_there_is_no_import_cycle():
    edges, done = module_imports(), set()

    def visit(name, trail):
        assert name not in trail, " -> ".join([*trail[trail.index(name) :], name])
        if name not in done:
            for other in sorted(edges[name]):
                visit(other, [*trail, name])
            done.add(name)

    for name in edges:
        visit(name, [])


@pytest.mark.parametrize("module", LIGHT)
def test_light_modules_import_nothing_heavy(module):
    code = f"import sys, {module}; print(sorted({HEAVY!r} & set(sys.modules)))"
    environment = os.environ | {"PYTHONPATH": str(REPOSITORY)}
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
