"""`ufrnn`: one console command, one module a subcommand. The only place where policy and door environment meet."""

import sys
from collections.abc import Callable, Sequence
from importlib import import_module

from draccus.utils import ParsingError

COMMANDS = {
    "demo": "record, train, evaluate and draw: the whole path with one command",
    "record": "record demonstrations of the scripted expert into a LeRobotDataset",
    "results": "turn the trial log of lerobot-eval into a table per door",
    "foresight": "draw what foresight imagines where the policy has to choose",
    "protocol": "train and evaluate models x seeds x checkpoints, resumably; table of all results",
    "curve": "draw the success rate over the epochs of training from that table",
    "hidden": "draw hidden states along the demonstrations and in a trial, model by model",
    "drift": "measure how far imagined futures drift from the demonstrations",
    "lyapunov": "draw how chaotic the imagined futures are along the demonstrations",
    "rehearse": "run trials on the digital twin of the robot, through stock lerobot-rollout",
    "operate": "record demonstrations on the digital twin of the robot, through stock lerobot-record",
    "faults": "make things fail while stock lerobot-record moves the twin; table of what became of it",
    "report": "put all results, tables, pictures and videos into one page",
    "benchmark": "time it against the readable code, XLA, ACT and Diffusion Policy",
}

USAGE = "usage: ufrnn COMMAND [--flag=value ...]\n\n" + "".join(
    f"  {name:<10} {summary}\n" for name, summary in COMMANDS.items()
)
USAGE += (
    "\n`ufrnn COMMAND --help` lists the flags of a command. Training and evaluation are LeRobot's own commands:\n"
    "  lerobot-train --policy.type=ufrnn --dataset.repo_id=...\n"
    "  lerobot-eval --policy.path=... --env.type=door --env.task=all\n"
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one subcommand.

    Args:
        arguments (`Sequence[str]`, *optional*):
            Command line without the program's name; `sys.argv[1:]` when not given.

    Returns:
        `int`: exit status: 0 done, 1 failed, 2 wrong usage, 130 interrupted.
    """
    name, *rest = list(sys.argv[1:] if arguments is None else arguments) or ["--help"]
    if name in ("-h", "--help"):
        print(USAGE, end="")
        return 0
    if name not in COMMANDS:
        print(f"ufrnn: unknown command '{name}'\n\n{USAGE}", end="", file=sys.stderr)
        return 2
    run: Callable[[list[str]], None] = import_module(f"{__name__}.{name}").run
    try:
        run(rest)
    except KeyboardInterrupt:
        print(f"\nufrnn {name}: interrupted", file=sys.stderr)
        return 130
    except (ValueError, OSError, RuntimeError, ParsingError) as error:
        print(f"ufrnn {name}: {error}", file=sys.stderr)
        return 1
    return 0
