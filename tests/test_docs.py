"""Whatever README and docs name is there: files, anchors, commands and their flags, fields of the policy, defaults."""

import re
import shlex
import tomllib
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, get_type_hints

import draccus
import pytest
import yaml
from lerobot.scripts.lerobot_record import RecordConfig

from env_door.configuration_door import DoorEnvConfig
from env_forks.configuration_forks import ForksEnvConfig
from env_forks.tasks import TASKS
from lerobot_ufrnn.commands import COMMANDS
from lerobot_ufrnn.configuration_ufrnn import UFRNNConfig
from lerobot_ufrnn.robots.ur5e_robotiq import UR5eRobotiqConfig
from lerobot_ufrnn.teleoperators import KeyboardTwistConfig, SpaceMouseTwistConfig

ROOT = Path(__file__).parents[1]
TODAY = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
PAGES = [*TODAY, ROOT / "CHANGELOG.md"]  # this one names what was, too
CONFIGS = sorted((ROOT / "configs").rglob("*.yaml"))
REPOSITORY = yaml.safe_load((ROOT / "CITATION.cff").read_text())["repository-code"]
IN_REPOSITORY = (
    f"{REPOSITORY}/blob/main/",
    f"{REPOSITORY.replace('//github.com', '//raw.githubusercontent.com')}/main/",
)
FOLDERS = "lerobot_ufrnn|env_door|env_forks|experiments|configs|docs|scripts|tests"


OTHERS = {
    "env": (DoorEnvConfig, ForksEnvConfig),
    "robot": (UR5eRobotiqConfig,),
    "teleop": (KeyboardTwistConfig, SpaceMouseTwistConfig),
}


def by_name(path: Path) -> str:
    return str(path.relative_to(ROOT))


def links(page: Path) -> Iterator[tuple[Path, str]]:
    """File and anchor of each link into the repository."""
    for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        base, target = page.parent, link
        for prefix in IN_REPOSITORY:
            if link.startswith(prefix):
                base, target = ROOT, link.removeprefix(prefix)
        if not target.startswith("https://"):
            name, _, anchor = target.partition("#")
            yield (base / name if name else page), anchor


def anchors(page: Path) -> set[str]:
    """Anchors of a page's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.+)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def code(path: Path) -> list[str]:
    """Lines of code blocks and spans of code of a page, or lines of another file, with continued lines joined."""
    text = path.read_text()
    if path.suffix == ".md":
        blocks = re.findall(r"```\w*\n(.*?)```", text, re.DOTALL)
        spans = re.findall(r"`([^`\n]+)`", re.sub(r"```.*?```", "", text, flags=re.DOTALL))
        text = "\n".join([*blocks, *spans])
    return re.sub(r"\\\n[ #]*", "", text).splitlines()


def commands(path: Path) -> Iterator[tuple[str, set[str]]]:
    """Each `ufrnn COMMAND` and `python experiments/SCRIPT` with the names of its flags."""
    for line in code(path):
        for found in re.finditer(r"\b(ufrnn [a-z][\w-]*|python experiments/\w+\.py)\b(.*)", line):
            words = shlex.split(re.sub(r"[<>]", "", found[2]), comments=True)
            yield found[1], {word[2:].split("=")[0] for word in words if word.startswith("--")} - {"help"}


def policy_flags(path: Path) -> set[tuple[str, str | None]]:
    """Name and value of each `--policy.*` flag; no value where a page leaves it open."""
    found = re.findall(r"--policy\.([a-z_.]+[a-z_])(?:=([^\s`'\"]+))?", "\n".join(code(path)))
    return {(name, value if re.fullmatch(r"[\w.,\-\[\]]+", value) else None) for name, value in found}


def nested(name: str, value: Any) -> dict[str, Any]:
    *groups, last = name.split(".")
    tree = {last: value}
    for group in reversed(groups):
        tree = {group: tree}
    return tree


def leaves(config: Any, prefix: str = "") -> dict[str, Any]:
    """Values of all fields by their dotted names."""
    found = {}
    for field in fields(config):
        value = getattr(config, field.name)
        name = f"{prefix}{field.name}"
        found |= leaves(value, f"{name}.") if is_dataclass(value) else {name: value}
    return found


@pytest.mark.parametrize("page", PAGES, ids=by_name)
def test_links_lead_to_files_and_headings(page: Path):
    for target, anchor in links(page):
        assert target.exists(), f"there is no {target}"
        assert not anchor or anchor in anchors(target), f"{target} has no heading for #{anchor}"


def test_links_of_the_readme_work_outside_of_the_repository():
    text = (ROOT / "README.md").read_text()
    assert not re.findall(r"\]\((?!https://)", text)
    assert all(prefix in text for prefix in IN_REPOSITORY)


def test_repository_is_the_one_of_the_package():
    urls = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"].get("urls", {})
    assert any(url.startswith(REPOSITORY) for url in urls.values()), f"{REPOSITORY} is not in [project.urls]: {urls}"


@pytest.mark.parametrize("path", [*TODAY, *CONFIGS], ids=by_name)
def test_files_that_are_named_exist(path: Path):
    text = path.read_text()
    for environment in ("env_door/Door-v0", "env_forks/Forks-v0"):  # names in Gymnasium's registry
        text = text.replace(environment, "")
    for name in re.findall(rf"(?<![\w/.])(?:{FOLDERS})/[\w./-]*\w", text):
        assert (ROOT / name).exists(), f"there is no {name}"


@pytest.mark.parametrize("path", [*TODAY, *CONFIGS], ids=by_name)
def test_commands_and_their_flags_exist(path: Path):
    for command, flags in commands(path):
        if command.startswith("ufrnn "):
            name = command.removeprefix("ufrnn ")
            assert name in COMMANDS
            run = import_module(f"lerobot_ufrnn.commands.{name.replace('-', '_')}").run
            known = {field.name for field in fields(get_type_hints(run).get("config", RecordConfig))}
        else:
            known = set(re.findall(r"\w+", (ROOT / command.removeprefix("python ")).read_text()))
        assert {flag.split(".")[0] for flag in flags} <= known, command


@pytest.mark.parametrize("path", [*TODAY, *CONFIGS], ids=by_name)
def test_flags_of_the_policy_are_fields(path: Path):
    for name, value in policy_flags(path):
        if name in ("type", "path"):  # LeRobot's own
            continue
        assert name in leaves(UFRNNConfig())
        if value is not None:
            draccus.decode(UFRNNConfig, nested(name, yaml.safe_load(value)))


@pytest.mark.parametrize("path", [*TODAY, *CONFIGS], ids=by_name)
def test_flags_of_environment_robot_and_teleoperator_are_fields(path: Path):
    for group, name in re.findall(r"--(env|robot|teleop)\.(\w+)", "\n".join(code(path))):
        known = {field.name for config in OTHERS[group] for field in fields(config)}
        assert name in known | {"type"}, f"--{group}.{name}"


@pytest.mark.parametrize("path", CONFIGS, ids=by_name)
def test_configurations_of_the_policy_are_valid(path: Path):
    policy = yaml.safe_load(path.read_text()).get("policy", {})
    if policy.pop("type", None) == "ufrnn":
        draccus.decode(UFRNNConfig, policy)


def test_flags_have_the_defaults_that_usage_says():
    table = re.findall(r"^\| `--policy\.([\w.]+)` \| `(.+?)` \|", (ROOT / "docs/usage.md").read_text(), re.MULTILINE)
    defaults = leaves(UFRNNConfig())
    assert len(table) > 20
    for name, text in table:
        value = yaml.safe_load(text)
        assert (tuple(value) if isinstance(value, list) else value) == defaults[name], name


def test_usage_has_every_ambiguous_task():
    rows = re.findall(r"^\| `(\w+)` \| (\d+) \| (.+) \|$", (ROOT / "docs/usage.md").read_text(), re.MULTILINE)
    assert rows == [(task.name, str(len(task.ways)), task.special) for task in TASKS.values()]


def test_changelog_has_every_field_in_a_group_with_its_old_name_or_as_new():
    rows = re.findall(r"^\| (`\w+`|new) \| `(\w+\.\w+)` \|$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    renamed = [old for old, _ in rows if old != "new"]
    assert len(set(renamed)) == len(renamed)
    assert len({new for _, new in rows}) == len(rows)
    groups = ("foresight.", "recall.", "autoencoder.", "augmentation.")
    assert {new for _, new in rows} == {name for name in leaves(UFRNNConfig()) if name.startswith(groups)}
