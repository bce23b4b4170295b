"""How fast is the door, and how long does the whole demo take?

python experiments/benchmark_door.py    # about six minutes; tables and numbers in outputs/benchmark
"""

import re
import resource
import subprocess
import sys
import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
from timing import take_turns, text, write

from env_door.configuration_door import DoorEnvConfig
from env_door.env import DoorEnv
from env_door.expert import DoorExpert
from lerobot_ufrnn.commands import with_this_python


def of_environment(seconds: float = 60.0, batch_size: int = 5, asynchronous=(False, True)) -> pd.DataFrame:
    """Steps a second of the door while the gripper holds the knob, which is slower than free movement."""
    with ExitStack() as stack:
        env = DoorEnv(start_variation=0.0)
        stack.callback(env.close)
        env.reset(seed=0, options={"kind": "slide"})
        expert = DoorExpert(env, ("push",))
        expert.reset(np.random.default_rng(0))
        actions = []
        for _ in range(expert.branch_step):  # to the knob, gripped and twisted
            actions.append(expert.act())
            env.advance(actions[-1])
        calls: dict[str, Callable[[], object]] = {
            "physics only": lambda: env.advance(actions[-1]),
            f"with {env.observation_size} px picture": lambda: env.step(actions[-1]),
            f"and {env.render_size} px video frame": lambda: (env.step(actions[-1]), env.render()),
        }
        steps = dict.fromkeys(calls, 1)
        for in_processes in asynchronous:
            # No episode may end while it is measured: LeRobot's finished environments cost nothing.
            config = DoorEnvConfig(task="slide", episode_length=10**9, start_variation=0.0)
            ((vector_env,),) = (tasks.values() for tasks in config.create_envs(batch_size, in_processes).values())
            stack.callback(vector_env.close)
            vector_env.reset(seed=0)
            for action in actions:
                vector_env.step(np.stack([action] * batch_size))
            name = f"batch of {batch_size}, {'async' if in_processes else 'sync'}"
            calls[name] = partial(vector_env.step, np.stack([actions[-1]] * batch_size))
            steps[name] = batch_size
        times = take_turns(calls, seconds, warm_up=3)
    return pd.DataFrame(
        {"what": name, "steps a second": text(1e3 * steps[name] / times[name]), "calls": len(times)} for name in calls
    )


def of_demo() -> pd.DataFrame:
    """`ufrnn demo` with default flags: its stages, what stock training logs, and the memory of its largest process."""
    with tempfile.TemporaryDirectory() as folder:
        command = [*with_this_python("ufrnn"), "demo", f"--output_dir={folder}/demo"]
        done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False)
    if done.returncode != 0:
        raise RuntimeError(f"ufrnn demo ended with status {done.returncode}:\n{done.stdout[-2000:]}")
    return read_demo(done.stdout, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 2**10)


def read_demo(output: str, memory: float) -> pd.DataFrame:
    """What `ufrnn demo` printed, as a table; training is judged once the image encoder is frozen."""
    stages = re.findall(r"(record|train|evaluate|draw) (\d+) s", output)
    encoded = output.partition("Autoencoder done")[2]
    # The first window ends with the autoencoder's last update.
    speeds = np.array(re.findall(r"updt_s:([\d.]+) data_s:([\d.]+)", encoded)[1:], float).reshape(-1, 2)
    rows = [(f"{stage} / s", float(seconds)) for stage, seconds in stages]
    rows += [("all / s", sum(seconds for _, seconds in rows)), ("peak memory / MiB", memory)]
    if len(speeds):
        update, data = 1e3 * np.median(speeds, axis=0)
        rows += [("update of stock training / ms", update), ("its wait for data / ms", data)]
    return pd.DataFrame(rows, columns=["what", "measured"]).round(1)


def main(output_dir: Path = Path("outputs/benchmark")) -> None:
    """Measures, prints and writes."""
    write("environment", of_environment.__doc__, of_environment(), output_dir)
    write("demo", of_demo.__doc__, of_demo(), output_dir)


if __name__ == "__main__":
    try:
        main()
    except RuntimeError as error:
        sys.exit(f"benchmark_door.py: {error}")
