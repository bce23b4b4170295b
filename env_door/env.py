"""The Gymnasium environment: an arm in front of a door whose kind it must find out by trying."""

import contextlib
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
from draccus.utils import ParsingError
from numpy.typing import NDArray

from env_door.checks import check_choice, check_range
from env_door.kinematics import InverseKinematics
from env_door.latch import EIGHT_KINDS, KINDS, Latch
from env_door.limits import FPS, IMAGE_SIZE, MAX_OFFSET, check_door
from env_door.rendering import Renderer, make_renderer
from env_door.scene import ARMS, GRIPPER_STROKE, load_model
from env_door.simulator import mujoco

CONTROL_STEPS = 50  # physics steps of 2 ms in one control step of 0.1 s
HOLD_OPENING = 0.15
"""Opening, as a fraction of what counts as open, at which somebody holds the door: 60 mrad or 21 mm, seen to move."""

START_DISTANCE = 0.16  # in m between the tool and the knob at the nominal start
GRIPPER_SPEED = 1.76
"""Largest change of the gripper target per second in units of its stroke (Robotiq 2F-85: 150 mm/s)."""

GRASP_ROTATION = np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])
"""Tool orientation for grasping the untwisted knob: z ahead into the door, fingers closing sideways (y)."""


class DoorEnv(gym.Env):
    """Door opening with an arm and a parallel gripper, at 10 Hz.

    ## Description

    The door opens by pushing, pulling or sliding. Nothing that can be seen or felt says which until the knob is twisted
    and the door is loaded in some direction; a wrong try leaves it shut.

    Harder kinds make it one of eight: it slides to the robot's left (`slide`) or right (`slide_right`), and the knob
    turns clockwise as the robot sees it or, with a name that ends in `_ccw`, counter-clockwise. A knob that is turned
    the wrong way is stopped.

    ## Action Space

    `Box` of `float32`, shape `(7,)` for the UR5e and `(8,)` for the Panda: absolute targets.

    | Index | Target              | Unit | Range                |
    |-------|---------------------|------|----------------------|
    | 0..-2 | joint angles        | rad  | ranges of the joints |
    | -1    | gripper's closure   | 1    | 0 open to 1 closed   |

    As on a real controller a target is limited to the joint ranges, to the joint speeds and to a distance from the
    measured joints before the arm moves towards it along a straight line.

    ## Observation Space

    | Key            | Shape             | Type      | What                                            |
    |----------------|-------------------|-----------|-------------------------------------------------|
    | `pixels/front` | `(size, size, 3)` | `uint8`   | the camera's picture                            |
    | `agent_pos`    | as an action      | `float32` | measured joint angles and the gripper's closure |

    ## Rewards

    1 in a step after which the door is open and nearly still, else 0.

    ## Starting State

    The door is shut and the open gripper in front of the knob. The same seed gives the same start pose and door
    position for every kind of door. `reset(options=...)` takes `kind` and `door_offset`, a fixed signed shift in m.

    ## Episode End

    Terminates when the door is open; truncated after 300 steps (`env_door/Door-v0`).

    ## Info

    `is_success`, `door_kind`, `opening` (0 closed, 1 open), `attempts` (directions in which the shut door was tried,
    and turns that the knob stopped, `turn_cw` or `turn_ccw`, in order), `held` (somebody holds it now),
    `tried_while_held` (ways other than its own tried meanwhile).

    ## Arguments

    | Argument           | Default       | What                                                                     |
    |--------------------|---------------|--------------------------------------------------------------------------|
    | `kind`             | `"random"`    | `"push"`, `"pull"`, `"slide"`, or `"random"`: one of these is drawn at   |
    |                    |               | every reset; also `"slide_right"`, `"push_ccw"`, `"pull_ccw"`,           |
    |                    |               | `"slide_ccw"` and `"slide_right_ccw"`                                    |
    | `eight`            | `False`       | whether the door is one of all eight kinds: `"random"` draws from them,  |
    |                    |               | and `attempts` tells them apart; a kind beyond the three always is       |
    | `arm`              | `"ur5e"`      | `"ur5e"` (6 joints) or `"panda"` (7 joints)                              |
    | `door_offset`      | `0.0`         | half-width in m, 0 to 0.05, of the range of the door's sideways shift    |
    | `start_variation`  | `0.02`        | half-width in m, 0 to 0.05, of the tool's start position along each axis |
    | `command_limit`    | `0.08`        | largest distance in rad, 0.01 to 1, of a joint target from the measured  |
    |                    |               | joint; keeps a blocked arm from folding up                               |
    | `hold_seconds`     | `0.0`         | seconds, 0 to 60, for which somebody holds the door still, once in a     |
    |                    |               | trial: from the first step that leaves it at least 15 % open             |
    | `observation_size` | `128`         | height and width of the observed image in pixels, 16 to 768              |
    | `render_size`      | `192`         | the same of the picture that `render` returns                            |
    | `render_mode`      | `"rgb_array"` | nothing else                                                             |

    Another value is a ValueError.

    ## Version History

    * v0: the first.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": FPS}  # noqa: RUF012 (Gymnasium declares it so)
    task = "open the door"
    task_description = "open the door"

    def __init__(
        self,
        kind: str = "random",
        arm: str = "ur5e",
        door_offset: float = 0.0,
        start_variation: float = 0.02,
        command_limit: float = 0.08,
        hold_seconds: float = 0.0,
        observation_size: int = IMAGE_SIZE,
        render_size: int = 192,
        render_mode: str = "rgb_array",
        eight: bool = False,
    ):
        asked = SimpleNamespace(**locals())
        with _as_value_error():
            check_door(asked)
            check_choice(asked, "kind", (*EIGHT_KINDS, "random"))
            check_range(asked, "observation_size", "render_size", low=16, high=768, unit="pixels")
            check_choice(asked, "render_mode", self.metadata["render_modes"])
        self.kind = kind
        self.eight = eight
        self.arm = ARMS[arm]
        self.door_offset = door_offset
        self.start_variation = start_variation
        self.command_limit = command_limit
        self.hold_seconds = hold_seconds
        self.observation_size = observation_size
        self.render_size = render_size
        self.render_mode = render_mode
        self.joint_names = (*self.arm.joints, "gripper")

        self.model = load_model(arm)
        self.data = mujoco.MjData(self.model)
        self.latch = Latch(self.model, self.data)
        self.kinematics = InverseKinematics(self.model, self.arm.joints)
        joints = [self.model.joint(name) for name in self.arm.joints]
        drives = [self.model.actuator(name) for name in self.joint_names]
        self._qpos = np.array([joint.qposadr[0] for joint in joints])
        self._fingers = [int(self.model.joint(name).qposadr[0]) for name in ("finger_left", "finger_right")]
        self._actuators = np.array([drive.id for drive in drives])
        # Seconds by which a position servo trails a moving target: damping over stiffness.
        self._servo_lag = np.array([*(-drive.biasprm[2] / drive.gainprm[0] for drive in drives[:-1]), 0.0])
        self._low, self._high = np.array([*(joint.range for joint in joints), (0.0, 1.0)]).T
        self._max_change = np.array([*self.arm.joint_speed, GRIPPER_SPEED]) * CONTROL_STEPS * self.model.opt.timestep
        self._doorway = int(self.model.body("doorway").id)
        self._doorway_home = self.model.body_pos[self._doorway].copy()
        self._target: NDArray[np.float64] = np.zeros(len(self.joint_names))
        self._to_be_held = False
        self._renderers: dict[str, Renderer] = {}
        self._picture: NDArray[np.uint8] | None = None
        self._picture_poses: NDArray[np.float64] = np.empty(0)

        self.action_space = gym.spaces.Box(self._low.astype(np.float32), self._high.astype(np.float32))
        image = gym.spaces.Box(0, 255, (observation_size, observation_size, 3), np.uint8)
        # Joint limits are soft in MuJoCo: a measurement may lie a little beyond them.
        measured = gym.spaces.Box((self._low - 0.5).astype(np.float32), (self._high + 0.5).astype(np.float32))
        self.observation_space = gym.spaces.Dict({"pixels": gym.spaces.Dict({"front": image}), "agent_pos": measured})

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Closes the door and puts the arm in front of it; an unknown or bad option is a ValueError."""
        super().reset(seed=seed)
        options = dict(options or {})
        # Always the same draws in the same order, whatever is overridden: seeds stay comparable across kinds.
        kinds = EIGHT_KINDS if self.eight else KINDS
        drawn_kind = kinds[self.np_random.integers(len(kinds))]
        drawn_offset = self.np_random.uniform(-1.0, 1.0) * self.door_offset
        start_shift = self.np_random.uniform(-1.0, 1.0, size=3) * self.start_variation
        kind = options.pop("kind", self.kind)
        offset = options.pop("door_offset", drawn_offset)
        if options:
            raise ValueError(f"unknown reset options {sorted(options)}; 'kind' and 'door_offset' are known")
        asked = SimpleNamespace(kind=kind, door_offset=offset)
        with _as_value_error():
            check_choice(asked, "kind", (*EIGHT_KINDS, "random"))
            check_range(asked, "door_offset", low=-MAX_OFFSET, high=MAX_OFFSET, unit="m")

        mujoco.mj_resetData(self.model, self.data)
        self.latch.reset(drawn_kind if kind == "random" else kind, self.eight)
        self._to_be_held = self.hold_seconds > 0
        self.current_offset = float(offset)
        self.model.body_pos[self._doorway] = self._doorway_home + np.array([0.0, self.current_offset, 0.0])
        start = self._doorway_home + self.model.site("knob").pos + np.array([-START_DISTANCE, 0.0, 0.0]) + start_shift
        joints = self.kinematics.solve(start, GRASP_ROTATION, np.array(self.arm.ready_pose))
        self.data.qpos[self._qpos] = joints
        self._target = np.append(joints, 0.0)
        self.data.ctrl[self._actuators] = self._control(self._target, np.zeros_like(self._target))
        mujoco.mj_forward(self.model, self.data)
        return self._observation(), self._info()

    def step(self, action: NDArray[np.float32]) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Moves towards a target for 0.1 s.

        Raises:
            ValueError: If the action has the wrong shape or is not finite.
            RuntimeError: If the physics diverged.
        """
        self.advance(action)
        success = self.latch.is_open
        return self._observation(), float(success), success, False, self._info()

    def advance(self, action: NDArray[np.float32]) -> None:
        """Moves the scene as `step` does, but draws no picture: for planning and measuring."""
        start, target = self._target, self.limit_action(action)
        velocity = (target - start) / (CONTROL_STEPS * self.model.opt.timestep)
        progress = np.arange(1, CONTROL_STEPS + 1)[:, None] / CONTROL_STEPS
        for control in self._control(start + (target - start) * progress, velocity):
            self._step_physics(control)
        self._target = target
        self._hold_if_due()
        self._check_physics()

    def limit_action(self, action: NDArray[np.float32]) -> NDArray[np.float64]:
        """The target that the controller really follows: within joint ranges, joint speeds and `command_limit`."""
        target = np.asarray(action, dtype=np.float64)
        if target.shape != self._target.shape:
            raise ValueError(f"action has shape {target.shape}; it must be {self._target.shape}: {self.joint_names}")
        if not np.isfinite(target).all():
            raise ValueError(f"action {target.tolist()} is not finite; every joint target must be a number")
        target = np.clip(target, self._low, self._high)
        target = np.clip(target, self._target - self._max_change, self._target + self._max_change)
        measured = self.measured_joints()[:-1]
        target[:-1] = np.clip(target[:-1], measured - self.command_limit, measured + self.command_limit)
        return target

    def measured_joints(self) -> NDArray[np.float64]:
        """Measured joint angles in rad and the gripper's closure (0 open, 1 closed)."""
        closure = self.data.qpos[self._fingers].sum() / GRIPPER_STROKE
        return np.append(self.data.qpos[self._qpos], closure)

    def hold_door(self, seconds: float) -> None:
        """Holds the panel where it is for some simulated seconds, then lets it go: interference."""
        if not (np.isfinite(seconds) and seconds >= 0):
            raise ValueError(f"seconds={seconds!r} must be a number that is not negative")
        self.latch.hold(round(seconds / self.model.opt.timestep))

    def render(self) -> NDArray[np.uint8]:  # type: ignore[override]
        """Picture of the scene for people, shape `(render_size, render_size, 3)`."""
        # LeRobot asks a finished environment for its picture until its whole batch is done: draw only what moved.
        poses = np.concatenate([self.data.geom_xpos, self.data.geom_xmat], axis=1)
        if self._picture is None or not np.array_equal(poses, self._picture_poses):
            self._picture, self._picture_poses = self._renderer("view").draw(self.data), poses
        return self._picture.copy()

    def close(self) -> None:
        """Frees the renderers."""
        for renderer in self._renderers.values():
            renderer.close()
        self._renderers.clear()

    def _control(self, target: NDArray[np.float64], velocity: NDArray[np.float64]) -> NDArray[np.float64]:
        # The target's own velocity is fed forward, so that a free arm follows closely although its gains are soft, and
        # a gap between command and measurement means that something blocks it.
        control = target + self._servo_lag * velocity
        control[..., -1] *= GRIPPER_STROKE
        return control

    def _step_physics(self, control: NDArray[np.float64]) -> None:
        self.data.ctrl[self._actuators] = control
        mujoco.mj_step(self.model, self.data)
        self.latch.update()

    def _hold_if_due(self) -> None:
        if self._to_be_held and self.latch.opening >= HOLD_OPENING:
            self._to_be_held = False
            self.hold_door(self.hold_seconds)

    def _check_physics(self) -> None:
        if not np.isfinite(self.data.qpos).all() or any(self.data.warning.number):
            names = [mujoco.mjtWarning(i).name for i in np.flatnonzero(self.data.warning.number)]
            raise RuntimeError(
                f"the physics diverged at {self.data.time:.2f} s ({', '.join(names) or 'state is not finite'}); "
                "reset the environment"
            )

    def _observation(self) -> dict[str, Any]:
        return {
            "pixels": {"front": self._renderer("front").draw(self.data)},
            "agent_pos": self.measured_joints().astype(np.float32),
        }

    def _info(self) -> dict[str, Any]:
        return {
            "is_success": self.latch.is_open,
            "door_kind": self.latch.kind,
            "opening": self.latch.opening,
            "attempts": self.latch.attempts,
            "held": self.latch.held,
            "tried_while_held": self.latch.tried_while_held,
        }

    def _renderer(self, camera: str) -> Renderer:
        if camera not in self._renderers:
            size, smooth = (self.observation_size, False) if camera == "front" else (self.render_size, True)
            self._renderers[camera] = make_renderer(self.model, camera, size, smooth)
        return self._renderers[camera]


@contextlib.contextmanager
def _as_value_error() -> Iterator[None]:
    """Gymnasium's users expect a ValueError where configurations raise what the parser of LeRobot's commands shows."""
    try:
        yield
    except ParsingError as error:
        raise ValueError(str(error)) from None
