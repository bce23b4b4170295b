"""`ufrnn`: one console command, one module a subcommand. The only place where policy and door environment meet."""

import sys
from collections.abc import Sequence
from importlib import import_module
from typing import get_type_hints

import draccus
from draccus.utils import DecodingError, ParsingError

# Nothing here imports LeRobot, PyTorch or MuJoCo: `ufrnn --help` answers at once, and a command that only starts others
# leaves their memory to them.
COMMANDS = {
    "demo": "record, train, evaluate and draw: the whole path with one command",
    "record": "record demonstrations of the scripted expert into a LeRobotDataset",
    "lerobot-record": "record with a robot: LeRobot's own command and flags, but each saved episode outlives a kill",
    "repair": "keep the whole episodes of a damaged LeRobotDataset, and say what was dropped",
    "results": "turn the trial log of lerobot-eval into a table per door",
    "foresight": "draw what foresight imagines where the policy has to choose",
    "video": "film a door that is found out: a wrong try, back to the fork, another try",
    "hidden": "draw hidden states along the demonstrations and in a trial, model by model",
    "lyapunov": "draw how chaotic the imagined futures are along the demonstrations",
    "report": "put the tables, pictures and videos of a folder into one page",
}

USAGE = f"""usage: ufrnn COMMAND [--flag=value ...]

{"".join(f"  {name:<15} {summary}\n" for name, summary in COMMANDS.items())}
`ufrnn COMMAND --help` explains the flags of a command. Training and evaluation are LeRobot's own commands:
  lerobot-train --policy.type=ufrnn --dataset.repo_id=...
  lerobot-eval --policy.path=... --env.type=door --env.task=all
"""


def with_this_python(name: str) -> list[str]:
    """A console command of ours or of LeRobot, such as `lerobot-train`, as one that this interpreter runs."""
    module = __name__ if name == "ufrnn" else f"lerobot.scripts.{name.replace('-', '_')}"
    return [sys.executable, "-m", module]


def parse_flags[Config](config_class: type[Config], arguments: list[str], prog: str) -> Config:
    """Builds a dataclass from flags such as `--seed=3`; the string below a field explains it in the help of `prog`.

    Raises:
        ValueError: If a value is of the wrong type or out of range; the message is the dataclass's own.
    """
    try:
        return draccus.parse(config_class, args=arguments, prog=prog)
    except DecodingError as error:  # a value of the wrong type: draccus names the flag
        raise ValueError(str(error)) from error
    except ParsingError as error:  # a value out of range: the dataclass says what is allowed, draccus does not
        raise ValueError(str(error.__cause__ or error)) from error


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one subcommand: the function `run` of its module, with the configuration or the words that `run` takes.

    Without `arguments` those of the command line. Exit status: 0 done, 1 failed, 2 wrong usage, 130 interrupted.
    """
    name, *rest = list(sys.argv[1:] if arguments is None else arguments) or ["--help"]
    if name in ("-h", "--help"):
        print(USAGE, end="")
        return 0
    if name not in COMMANDS:
        print(f"ufrnn: unknown command '{name}'\n\n{USAGE}", end="", file=sys.stderr)
        return 2
    try:
        run = import_module(f"{__name__}.{name.replace('-', '_')}").run
        config_class = get_type_hints(run).get("config")
        run(parse_flags(config_class, rest, f"ufrnn {name}") if config_class else rest)
    except KeyboardInterrupt:
        print(f"\nufrnn {name}: interrupted", file=sys.stderr)
        return 130
    except (ValueError, OSError, RuntimeError, ParsingError) as error:
        print(f"ufrnn {name}: {error}", file=sys.stderr)
        return 1
    return 0
