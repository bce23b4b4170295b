"""The Gymnasium environment of all tasks."""

from collections import deque
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike

from env_forks.corridors import Corridors
from env_forks.picture import Picture
from env_forks.tasks import FPS, IMAGE_SIZE, TASKS

HOME_RADIUS = 0.05  # within which the disc is back at the start


class ForksEnv(gym.Env):
    """A disc finds its way through corridors that fork, at 10 Hz.

    ## Description

    Each way is shut by a gate, and the gates look alike. One gives way when it is pressed on. `env_forks.tasks.TASKS`
    lists the tasks and what is special about each.

    ## Action Space

    `Box` of `float32`, shape `(2,)`: where the disc shall go, from the lower left corner (0, 0) of the picture to the
    upper right one (1, 1). A target is held within 0.12 of the disc, which moves at most 0.03 a step.

    ## Observation Space

    | Key            | Shape         | Type      | What                                                      |
    |----------------|---------------|-----------|-----------------------------------------------------------|
    | `pixels/front` | `(64, 64, 3)` | `uint8`   | the plane from above                                      |
    | `agent_pos`    | `(2,)`        | `float32` | measured position; gives a little when the disc is pulled |

    ## Rewards

    1 in a step after which the task is done, else 0.

    ## Starting State

    The same seed gives the same start for every way. `reset(options=...)` takes `way`, the one that goes on, and
    `demonstration`: whether to set up a demonstration, in which gates give way at once.

    ## Episode End

    Terminates when the task is done, and in `shown` at a wrong try; truncated after 300 steps (`env_forks/Forks-v0`).

    ## Info

    `is_success`, `attempts` (ways that were pressed on, in order), `way` (the hidden one).

    ## Arguments

    | Argument      | Default        | What                                                     |
    |---------------|----------------|----------------------------------------------------------|
    | `task`        | `"three_ways"` | name of a task                                           |
    | `way`         | `None`         | number of the way that goes on; drawn at every reset     |
    | `render_size` | `256`          | height and width of the picture that `render` returns    |
    | `render_mode` | `"rgb_array"`  | nothing else                                             |

    Another value is a ValueError.

    ## Version History

    * v0: the first.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": FPS}  # noqa: RUF012 (Gymnasium declares it so)
    joint_names: tuple[str, ...] = ("x", "y")
    task_description = "find the way through"

    def __init__(
        self,
        task: str = "three_ways",
        way: int | None = None,
        render_size: int = 256,
        render_mode: str = "rgb_array",
    ):
        if task not in TASKS:
            raise ValueError(f"task must be one of {', '.join(TASKS)}, got {task!r}.")
        if render_mode not in self.metadata["render_modes"]:
            raise ValueError(f"render_mode must be one of {self.metadata['render_modes']}, got {render_mode!r}.")
        if not 16 <= render_size <= 768:
            raise ValueError(f"render_size must be at least 16 and at most 768 pixels, got {render_size}.")
        self.task = TASKS[task]
        self.way = way if way is None else self._checked_way(way)
        self.render_size = render_size
        self.render_mode = render_mode
        self.action_space = gym.spaces.Box(0.0, 1.0, (2,), np.float32)
        self.observation_space = gym.spaces.Dict(
            {
                "agent_pos": gym.spaces.Box(-0.5, 1.5, (2,), np.float32),
                "pixels": gym.spaces.Dict({"front": gym.spaces.Box(0, 255, (IMAGE_SIZE, IMAGE_SIZE, 3), np.uint8)}),
            }
        )

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Starts a trial, or with `options={"demonstration": True}` a demonstration."""
        super().reset(seed=seed)
        options = dict(options or {})
        way, demonstration = options.pop("way", self.way), options.pop("demonstration", False)
        if options:
            raise ValueError(f"options may hold way and demonstration, got {sorted(options)} too.")
        task = self.task
        # Nothing that is drawn depends on the way, nor on whether the way is.
        self.nodes = np.array(task.tree.nodes) + self.np_random.uniform(-task.shift, task.shift, 2)
        position = self.nodes[0] + self.np_random.uniform(-task.start, task.start, 2) * (1, 0.3)
        drawn = int(self.np_random.integers(len(task.ways)))
        self.current_way = drawn if way is None else self._checked_way(way)
        self.world = self._make_world()(task, self.nodes, position, self.current_way)
        self._picture = Picture(task, self.nodes, self.current_way, IMAGE_SIZE)
        self._large_picture: Picture | None = None
        self._shut_steps = 0 if demonstration else task.shut_steps
        self._steps = 0
        self.path: list[tuple[float, float]] = []
        self._note_position()
        self._attempts: list[int] = []
        self._arrived = self._failed = self._done = False
        self._seen: deque[tuple[np.ndarray, np.ndarray]] = deque(maxlen=task.delay + 1)
        return self._observe(), self._info()

    def step(self, action: ArrayLike):
        """Moves towards a target for 0.1 s."""
        target = np.asarray(action, float)
        if target.shape != (2,) or not np.isfinite(target).all():
            raise ValueError(f"An action must hold two finite numbers, got {action!r}.")
        pressed = self.world.move(target, may_open=self._steps >= self._shut_steps)
        self._steps += 1
        self._note_position()
        if pressed is not None and self._attempts[-1:] != [pressed]:
            self._attempts.append(pressed)
        self._failed |= self.task.cue and pressed not in (None, self.current_way)
        self._arrived |= self.world.arrived
        if self._arrived and not self._failed:
            home = np.linalg.norm(self.nodes[0] - self.world.position) < HOME_RADIUS
            self._done |= bool(home) or not self.task.back
        return self._observe(), float(self._done), self._done or self._failed, False, self._info()

    def render(self) -> np.ndarray:
        """The plane from above, as it is now."""
        if self._large_picture is None:
            self._large_picture = Picture(self.task, self.nodes, self.current_way, self.render_size)
        return self._draw(self._large_picture)

    def _note_position(self) -> None:
        x, y = self.world.position
        self.path.append((round(float(x), 3), round(float(y), 3)))

    def _make_world(self) -> type:
        if not self.task.contact:
            return Corridors
        from env_forks.blocks import Blocks  # MuJoCo comes with the first task that needs it

        return Blocks

    def _draw(self, picture: Picture) -> np.ndarray:
        return picture.draw(self.world.position, self.world.gates, lit=self._arrived)

    def _observe(self) -> dict[str, Any]:
        measured = self.world.measured
        if self.task.noise:
            measured = measured + self.np_random.normal(0, self.task.noise, 2)
        self._seen.append((measured.astype(np.float32), self._draw(self._picture)))
        position, picture = self._seen[0]
        return {"agent_pos": position.copy(), "pixels": {"front": picture.copy()}}

    def _info(self) -> dict[str, Any]:
        return {"is_success": self._done, "attempts": tuple(self._attempts), "way": self.current_way}

    def _checked_way(self, way: int) -> int:
        if way not in self.task.ways:
            raise ValueError(f"way must be from 0 to {len(self.task.ways) - 1} in {self.task.name}, got {way!r}.")
        return int(way)
