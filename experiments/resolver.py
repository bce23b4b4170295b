"""Does this package install beside others? `python experiments/resolver.py` writes a table of it.

Asks `uv pip compile` for an environment with this package and a partner, for each extra of LeRobot and for popular
simulators and plug-ins, with Python 3.12 and 3.13. Nothing is installed; each answer takes seconds. LeRobot with the
partner alone is asked, too: a no may be theirs, and a yes may rest on an older version of the partner.
"""

import shutil
import subprocess
import sys
from dataclasses import dataclass, field
from importlib.metadata import metadata, version
from pathlib import Path

import pandas as pd
from script import run
from tqdm import tqdm

from lerobot_ufrnn.analysis.results import markdown

ROOT = Path(__file__).parents[1]
PYTHONS = ("3.12", "3.13")
# Extras of the installed LeRobot that a user would ask for; those that end so only gather dependencies of others.
EXTRAS = [name for name in metadata("lerobot").get_all("Provides-Extra") or [] if not name.endswith("-dep")]
# Simulators that use MuJoCo and are common beside LeRobot, then third-party plug-ins of LeRobot.
OTHERS = """
    gym-hil gym-aloha gym-pusht gymnasium-robotics metaworld robosuite hf-libero mani-skill dm-control mink
    lerobot-env-so101 lerobot-policy-turbovla lerobot-policy-act-smooth lerobot-policy-act-ttt lerobot-policy-rewact
    lerobot-robot-xarm lerobot-robot-piper lerobot-robot-seeed-b601 lerobot-teleoperator-spacemouse
    lerobot-teleoperator-teleop
"""
PARTNERS = [*(f"lerobot[{name}]" for name in EXTRAS), *OTHERS.split()]


@dataclass
class ResolverConfig:
    """What to resolve."""

    partners: list[str] = field(default_factory=lambda: PARTNERS)  # requirements to resolve beside this package
    output: Path = ROOT / "experiments" / "results" / "resolver.md"  # file for the table


def resolve(uv: str, requirements: list[str], python: str) -> tuple[dict[str, str], str]:
    """Versions that fit together, or none and why: uv's hint, if it gives one."""
    done = subprocess.run(
        [uv, "pip", "compile", "--quiet", "--no-header", "--no-annotate", "--python-version", python, "-"],
        input="\n".join(requirements),
        capture_output=True,
        text=True,
        cwd=ROOT,
    )
    if done.returncode == 0:
        return dict(line.split(" ;")[0].split("==") for line in done.stdout.splitlines() if "==" in line), ""
    return {}, " ".join(done.stderr.split()).split("hint: ")[-1].replace("|", "\\|")[:300]


def row(uv: str, partner: str) -> dict[str, str]:
    """What becomes of one partner."""
    entry, notes, name = {"beside": f"`{partner}`"}, [], partner.split("[")[0]
    for python in PYTHONS:
        chosen, message = resolve(uv, [f"lerobot_policy_ufrnn @ {ROOT.as_uri()}", partner], python)
        entry[f"Python {python}"] = "yes" if chosen else "no"
        entry[f"its version ({python})"] = chosen.get(name, "")
        entry[f"MuJoCo ({python})"] = chosen.get("mujoco", "")
        if chosen and name == "lerobot":
            continue
        alone, alone_message = resolve(uv, [f"lerobot=={version('lerobot')}", partner], python)
        if not alone:
            notes.append(f"{python}: nor beside LeRobot alone: {alone_message}")
        elif alone.get(name) != chosen.get(name):
            with_mujoco = f"{alone.get(name)} with MuJoCo {alone.get('mujoco', 'none')}"
            notes.append(f"{python}: beside LeRobot alone {with_mujoco}{message and '; ' + message}")
    return entry | {"note": "; ".join(notes)}


def main(config: ResolverConfig) -> None:
    """Asks for all partners and writes the table."""
    uv = shutil.which("uv") or shutil.which(ROOT / ".uv" / "bin" / "uv")
    if uv is None:
        raise RuntimeError("uv is needed: `pip install uv`, or run scripts/setup")
    rows = [row(uv, partner) for partner in tqdm(config.partners, unit="partner")]
    text = (
        f"Beside which packages this one can be installed (LeRobot {version('lerobot')}, asked on "
        f"{pd.Timestamp.now():%Y-%m-%d} for {sys.platform}; `python experiments/resolver.py`).\n\n"
        + markdown(pd.DataFrame(rows))
    )
    print(text)
    config.output.parent.mkdir(parents=True, exist_ok=True)
    config.output.write_text(text)


if __name__ == "__main__":
    run(main, ResolverConfig)
