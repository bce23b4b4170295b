"""Does the door keep its promises? `python experiments/door_check.py --seeds 100` prints what the documentation claims.

Opening by the scripted expert at every offset and order of tries, distance of command and measurement, equality of the
kinds before a try, speed. Needs no learning code and no data. With 100 seeds it takes about five minutes on one core.
"""

import argparse
import itertools
import time
import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import gymnasium as gym
import numpy as np
from gymnasium.utils.env_checker import check_env
from tqdm import tqdm

from env_door.env import DoorEnv
from env_door.expert import DoorExpert
from env_door.latch import KINDS
from env_door.limits import MAX_OFFSET
from env_door.ray_casting import RayCastRenderer
from env_door.rendering import make_renderer
from env_door.scene import ARMS


@dataclass(frozen=True)
class Run:
    """What one expert episode showed."""

    success_step: int | None
    """Step at which the door was open; `None` if it never was, or if other directions than asked for were tried."""
    free_lag: float
    """Largest distance in rad between commanded and measured joints before the first try."""
    blocked_lag: float
    """The same while a wrong direction was tried; 0 without wrong tries."""
    grip_gap: float
    """Largest distance between commanded and measured gripper once it holds the knob, in units of the stroke."""


def run_expert(env: DoorEnv, directions: tuple[str, ...], seed: int, offset: float | None = None) -> Run:
    """Lets the expert try some directions on a door that opens in the last of them."""
    options = {"kind": directions[-1]} | ({} if offset is None else {"door_offset": offset})
    env.reset(seed=seed, options=options)
    expert = DoorExpert(env, directions)
    expert.reset(np.random.default_rng(seed))
    free, blocked, grip, success_step = [0.0], [0.0], [0.0], None
    step = 0
    while success_step is None and step < 300:
        phase, action = expert.phase, expert.act()
        env.advance(action)
        gap = np.abs(action - env.measured_joints())
        if step < expert.branch_step:
            free.append(gap[:-1].max())
        elif phase.startswith("try"):
            blocked.append(gap[:-1].max())
        if phase not in ("approach", "advance", "grasp"):
            grip.append(gap[-1])
        if env.latch.is_open:
            success_step = step
        step += 1
    if env.latch.attempts != directions or env.latch.tried_while_held:
        success_step = None
    return Run(success_step, max(free), max(blocked), max(grip))


def expert_table(
    env: DoorEnv, seeds: int, sequences: Iterable[tuple[str, ...]], offsets: Iterable[float | None]
) -> None:
    """Prints one line of success, time and lag for each sequence of directions and each door offset."""
    for directions, offset in itertools.product(sequences, offsets):
        name = " > ".join(directions) + (f", held {env.hold_seconds:g} s" if env.hold_seconds else "")
        where = f"+-{MAX_OFFSET} m drawn" if offset is None else f"{offset:+.2f} m"
        runs = [run_expert(env, directions, seed, offset) for seed in tqdm(range(seeds), desc=name, leave=False)]
        steps = [run.success_step for run in runs if run.success_step is not None]
        failed = [seed for seed, run in enumerate(runs) if run.success_step is None]
        print(
            f"{env.arm.name:6} {name:22} {where:15} opened {len(steps):3}/{seeds:<3} "
            f"at step {min(steps, default=-1):3}-{max(steps, default=-1):3}  "
            f"lag free {max(run.free_lag for run in runs):.4f} blocked {max(run.blocked_lag for run in runs):.3f} rad  "
            f"grip gap {max(run.grip_gap for run in runs):.3f}" + (f"  failed seeds {failed[:10]}" if failed else ""),
            flush=True,
        )


def largest_difference_before_try(env: DoorEnv, seed: int) -> tuple[float, int, int]:
    """Compares all kinds of door at one seed up to the branch, where the same actions have been taken: the largest
    difference of any element of the simulator's position (rad or m), of any pixel, and the number of steps compared."""
    traces = []
    for kind in KINDS:
        observation, _ = env.reset(seed=seed, options={"kind": kind})
        expert = DoorExpert(env, (kind,))
        expert.reset(np.random.default_rng(seed))
        positions, images = [env.data.qpos.copy()], [observation["pixels"]["front"]]
        for _ in range(expert.branch_step):
            observation = env.step(expert.act())[0]
            positions.append(env.data.qpos.copy())
            images.append(observation["pixels"]["front"])
        traces.append((np.array(positions), np.array(images, dtype=np.int16)))
    first_positions, first_images = traces[0]
    position = max(float(np.abs(positions - first_positions).max()) for positions, _ in traces)
    pixel = max(int(np.abs(images - first_images).max()) for _, images in traces)
    return position, pixel, len(first_positions) - 1


def milliseconds(function: Callable[[], object], repeats: int) -> float:
    """Median time of a call in milliseconds."""
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        function()
        times.append(time.perf_counter() - begin)
    return float(np.median(times)) * 1000


def speed_table(env: DoorEnv) -> None:
    """Prints the time of a control step, with the knob in the gripper, and of a picture."""
    env.reset(seed=0, options={"kind": "slide"})
    expert = DoorExpert(env, ("push",))
    expert.reset(np.random.default_rng(0))
    for _ in range(expert.branch_step):
        env.advance(expert.act())
    action = expert.act()
    physics, whole = milliseconds(lambda: env.advance(action), 100), milliseconds(lambda: env.step(action), 100)
    for name, duration in (("without picture", physics), ("with picture", whole)):
        print(f"control step {name:16} {duration:.2f} ms, {1000 / duration:.0f} a second")
    size = env.observation_size
    for renderer in (make_renderer(env.model, "front", size), RayCastRenderer(env.model, "front", size)):
        frame = milliseconds(lambda renderer=renderer: renderer.draw(env.data), 50)  # type: ignore[misc]
        print(f"{type(renderer).__name__:16} {frame:.2f} ms for {size}x{size} pixels")
        renderer.close()
    print(f"render()         {milliseconds(env.render, 5):.1f} ms for {env.render_size}x{env.render_size} pixels")


def main() -> None:
    """Runs every measurement."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=100, help="episodes for each kind and offset (default 100)")
    parser.add_argument("--arm", choices=sorted(ARMS), default="ur5e", help="which arm (default ur5e)")
    parser.add_argument(
        "--wrong_seeds", type=int, default=20, help="episodes for each wrong-then-right order (default 20)"
    )
    arguments = parser.parse_args()
    if arguments.seeds < 1 or arguments.wrong_seeds < 0:
        parser.error("--seeds must be at least 1 and --wrong_seeds at least 0")

    env = DoorEnv(arm=arguments.arm, door_offset=MAX_OFFSET)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_env(gym.make("env_door/Door-v0", arm=arguments.arm).unwrapped)
    print(f"gymnasium's check_env passes with {len(caught)} warnings")
    for warning in caught:
        print("   ", str(warning.message)[:160])
    speed_table(env)
    compared = [largest_difference_before_try(env, seed) for seed in tqdm(range(5), desc="before a try", leave=False)]
    print(
        f"largest difference across kinds before a try: {max(c[0] for c in compared)} rad or m, "
        f"{max(c[1] for c in compared)} of 255 in a pixel, over {sum(c[2] for c in compared)} steps"
    )
    expert_table(env, arguments.seeds, [(kind,) for kind in KINDS], (0.0, -MAX_OFFSET, MAX_OFFSET, None))
    if arguments.wrong_seeds:
        orders = [order for length in (2, 3) for order in itertools.permutations(KINDS, length)]
        expert_table(env, arguments.wrong_seeds, orders, (None,))
    env.hold_seconds = 3.0
    expert_table(env, arguments.seeds, [(kind,) for kind in KINDS], (None,))
    env.close()


if __name__ == "__main__":
    gym.logger.min_level = gym.logger.WARN
    main()
