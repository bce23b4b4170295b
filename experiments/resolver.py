"""Does this package install beside others? `python experiments/resolver.py` writes a table of it.

Asks `uv pip compile` for an environment with this package and a partner, for each extra of LeRobot and for popular
simulators and plug-ins, with Python 3.12 and 3.13. Nothing is installed; each answer takes seconds. LeRobot with the
partner alone is asked, too: a no may be theirs, and a yes may rest on an older version of the partner.
"""

import argparse
import re
import shutil
import subprocess
import sys
from importlib.metadata import metadata, version
from pathlib import Path

import pandas as pd
from tqdm import tqdm

ROOT = Path(__file__).parents[1]
PYTHONS = ("3.12", "3.13")
# Simulators that use MuJoCo and are common beside LeRobot, then third-party plug-ins of LeRobot.
PARTNERS = (
    "gym-hil",
    "gym-aloha",
    "gym-pusht",
    "gymnasium-robotics",
    "metaworld",
    "robosuite",
    "hf-libero",
    "mani-skill",
    "dm-control",
    "mink",
    "lerobot-env-so101",
    "lerobot-policy-turbovla",
    "lerobot-policy-act-smooth",
    "lerobot-policy-act-ttt",
    "lerobot-policy-rewact",
    "lerobot-robot-xarm",
    "lerobot-robot-piper",
    "lerobot-robot-seeed-b601",
    "lerobot-teleoperator-spacemouse",
    "lerobot-teleoperator-teleop",
)
# Extras that only gather single dependencies of others.
PARTS = re.compile(r"-dep$")


def lerobot_extras() -> list[str]:
    """Extras of the installed LeRobot that a user would ask for."""
    names = metadata("lerobot").get_all("Provides-Extra") or []
    return [f"lerobot[{name}]" for name in names if not PARTS.search(name)]


def resolve(uv: str, requirements: list[str], python: str) -> tuple[dict[str, str], str]:
    """Versions that fit together, or none and what uv says of it."""
    done = subprocess.run(
        [uv, "pip", "compile", "--quiet", "--no-header", "--no-annotate", "--python-version", python, "-"],
        input="\n".join(requirements),
        capture_output=True,
        text=True,
        cwd=ROOT,
    )
    if done.returncode == 0:
        return dict(line.split(" ;")[0].split("==") for line in done.stdout.splitlines() if "==" in line), ""
    return {}, " ".join(done.stderr.split())


def reason(message: str) -> str:
    """What clashes: uv's hint if it gives one, else the last dependency of its chain of conclusions, best on MuJoCo."""
    if "hint: " in message:
        text = message.split("hint: ", 1)[1]
    else:
        facts = re.findall(r"[Bb]ecause (\S+ depends on \S+)", message) or [message]
        text = ([fact for fact in facts if "mujoco" in fact] or facts)[-1]
    return text if len(text) < 200 else text[:197] + "..."


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
        if alone and alone.get(name) != chosen.get(name):
            with_mujoco = f"{alone.get(name)} with MuJoCo {alone.get('mujoco', 'none')}"
            notes.append(f"{python}: beside LeRobot alone {with_mujoco}{message and '; ' + reason(message)}")
        elif not alone:
            notes.append(f"{python}: nor beside LeRobot alone: {reason(alone_message)}")
    return entry | {"note": "; ".join(notes)}


def to_markdown(rows: list[dict[str, str]]) -> str:
    """The rows as a table."""
    frame = pd.DataFrame(rows).fillna("")
    cells = [list(frame.columns), ["---"] * len(frame.columns), *frame.values.tolist()]
    return "\n".join("| " + " | ".join(text.replace("|", "\\|") for text in line) + " |" for line in cells) + "\n"


def main() -> None:
    """Asks for all partners, or for those named, and writes the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("partners", nargs="*", help="requirements to resolve beside this package (default: all known)")
    parser.add_argument("--output", type=Path, default=ROOT / "experiments" / "results" / "resolver.md")
    arguments = parser.parse_args()
    uv = shutil.which("uv") or str(ROOT / ".uv" / "bin" / "uv")
    if not shutil.which(uv):
        sys.exit("uv is needed: `pip install uv`, or run scripts/setup")
    partners = arguments.partners or [*lerobot_extras(), *PARTNERS]
    rows = [row(uv, partner) for partner in tqdm(partners, unit="partner")]
    text = (
        f"Beside which packages this one can be installed (LeRobot {version('lerobot')}, asked on "
        f"{pd.Timestamp.now():%Y-%m-%d} for {sys.platform}; `python experiments/resolver.py`).\n\n" + to_markdown(rows)
    )
    print(text)
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    arguments.output.write_text(text)


if __name__ == "__main__":
    main()
