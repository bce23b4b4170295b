import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def imported_packages(file: Path) -> set[str]:
    names = set()
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            names.add((node.module or "").split(".")[0])
    return names


@pytest.mark.parametrize("file", sorted((ROOT / "env_door").rglob("*.py")), ids=lambda file: file.stem)
def test_the_door_knows_nothing_of_learning(file):
    assert not imported_packages(file) & {"lerobot_ufrnn", "torch"}


@pytest.mark.parametrize("file", sorted((ROOT / "lerobot_ufrnn").rglob("*.py")), ids=lambda file: file.stem)
def test_policy_and_door_meet_only_where_one_is_run_in_the_other_and_where_the_arm_or_its_trials_are_known(file):
    allowed = file.parent.name in ("commands", "benchmarks", "experiments")
    allowed |= file == ROOT / "lerobot_ufrnn" / "analysis" / "results.py"
    allowed |= file == ROOT / "lerobot_ufrnn" / "teleoperators" / "tool_target.py"
    assert allowed or "env_door" not in imported_packages(file)


@pytest.mark.parametrize("file", sorted((ROOT / "lerobot_ufrnn" / "networks").glob("*.py")), ids=lambda file: file.stem)
def test_the_networks_do_not_know_lerobot(file):
    assert "lerobot" not in imported_packages(file)
