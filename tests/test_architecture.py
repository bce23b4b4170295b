"""Which part may import which."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
POLICY = ROOT / "lerobot_ufrnn"

PARTS = ("env_door", "env_forks", "lerobot_ufrnn", "experiments")

files_of = {name: sorted((ROOT / name).rglob("*.py")) for name in PARTS}


def imported_modules(file: Path) -> set[str]:
    """Absolute names of the modules that a file imports, wherever in it."""
    names = set()
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            package = file.relative_to(ROOT).with_suffix("").parts[: -node.level] if node.level else ()
            names.add(".".join((*package, *filter(None, [node.module]))))
    return names


def packages(file: Path) -> set[str]:
    return {name.split(".")[0] for name in imported_modules(file)}


@pytest.mark.parametrize("file", files_of["env_door"], ids=lambda file: file.stem)
def test_the_door_knows_nothing_of_learning(file):
    assert not packages(file) & {"lerobot_ufrnn", "torch", "env_forks"}


@pytest.mark.parametrize("file", files_of["env_forks"], ids=lambda file: file.stem)
def test_the_ambiguous_tasks_know_nothing_of_learning(file):
    assert not packages(file) & {"lerobot_ufrnn", "torch"}


@pytest.mark.parametrize("file", files_of["lerobot_ufrnn"], ids=lambda file: file.stem)
def test_the_policy_knows_the_door_only_where_a_command_joins_them(file):
    allowed = {"env_door.checks", "env_door.kinematics", "env_door.scene"}  # neither simulator nor learning in them
    if file.parent == POLICY / "commands" or file == POLICY / "analysis" / "results.py":
        return
    found = {name for name in imported_modules(file) if name.split(".")[0] in ("env_door", "env_forks")}
    assert not found - allowed


@pytest.mark.parametrize("file", sorted((POLICY / "networks").glob("*.py")), ids=lambda file: file.stem)
def test_the_networks_do_not_know_lerobot(file):
    assert "lerobot" not in packages(file)


def test_what_is_installed_does_not_know_the_experiments():
    scripts = {file.stem for file in files_of["experiments"]} | {"experiments"}
    for file in (*files_of["env_door"], *files_of["env_forks"], *files_of["lerobot_ufrnn"]):
        assert not packages(file) & scripts, file


def test_no_module_of_the_policy_imports_one_that_imports_it():
    """Arrows point one way."""
    graph = {}
    for file in files_of["lerobot_ufrnn"]:
        name = ".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        graph[name] = {found for found in imports_at_load(file) if found.startswith("lerobot_ufrnn.")}
    for name in graph:
        reached, frontier = set(), {name}
        while frontier:
            frontier = set().union(*(graph.get(module, set()) for module in frontier)) - reached
            reached |= frontier
        assert name not in reached, name


def imports_at_load(file: Path) -> set[str]:
    """What is imported when the module is, without what only type checkers read."""
    tree = ast.parse(file.read_text())
    tree.body = [node for node in tree.body if isinstance(node, ast.Import | ast.ImportFrom)]
    names = set()
    for node in tree.body:
        if isinstance(node, ast.ImportFrom):
            package = file.relative_to(ROOT).with_suffix("").parts[: -node.level] if node.level else ()
            base = ".".join((*package, *filter(None, [node.module])))
            names |= {base} | {f"{base}.{alias.name}" for alias in node.names}
    return names
