"""The same task with contact: a finger between walls pushes blocks, of which one slides and the others are held."""

import math

import numpy as np

from env_door.simulator import mujoco
from env_forks.corridors import MAX_PULL, MAX_STEP, limited, nearest_on_lines
from env_forks.picture import DISC_RADIUS, HALF_BLOCK
from env_forks.tasks import FPS, Task

TIMESTEP = 0.002
SUBSTEPS = round(1 / FPS / TIMESTEP)
SLIDE = 0.3  # how far a block can slide
FAR_ENOUGH = 0.2  # how far it must be pushed
PEG_RADIUS = 0.01  # of the pegs that walls are made of, one beside the other

# One unit is a metre. Gravity has no part in it: everything moves in a plane.
SCENE = """
<mujoco>
  <option timestep="{timestep}" gravity="0 0 0" integrator="implicitfast"/>
  <worldbody>
    <body name="finger" pos="{x} {y} 0">
      <joint name="x" type="slide" axis="1 0 0" damping="4"/>
      <joint name="y" type="slide" axis="0 1 0" damping="4"/>
      <geom name="finger" type="cylinder" size="{radius} 0.03" mass="0.2" friction="0.3" conaffinity="3"/>
    </body>
    {blocks}
    {pegs}
  </worldbody>
  <actuator>
    <position name="x" joint="x" kp="200" kv="12" forcerange="-20 20"/>
    <position name="y" joint="y" kp="200" kv="12" forcerange="-20 20"/>
  </actuator>
</mujoco>
"""
BLOCK = """
    <body name="block_{way}" pos="{x} {y} 0" euler="0 0 {degrees}">
      <joint name="block_{way}" type="slide" axis="0 1 0" damping="2" frictionloss="0.5" range="0 {range}"
             limited="true"/>
      <geom name="block_{way}" type="box" size="{size} 0.03" mass="0.2" friction="0.3"/>
    </body>
"""
# The finger touches it, blocks do not.
PEG = '<geom type="sphere" size="{radius}" pos="{x} {y} 0" friction="0" contype="2" conaffinity="0"/>'


class Blocks:
    """One trial, with the interface of [`~env_forks.corridors.Corridors`]."""

    def __init__(self, task: Task, nodes: np.ndarray, position: np.ndarray, way: int):
        blocks = []
        ends = nodes[list(task.tree.ends)]
        for other, ((x, y), (end_x, end_y)) in enumerate(zip(task.gates(nodes), ends, strict=True)):
            degrees = -math.degrees(math.atan2(end_x - x, end_y - y))
            slide, size = SLIDE if other == way else 1e-4, " ".join(map(str, HALF_BLOCK))
            blocks.append(BLOCK.format(way=other, x=x, y=y, degrees=degrees, range=slide, size=size))
        x, y = position
        pegs = "".join(PEG.format(radius=PEG_RADIUS, x=x, y=y) for x, y in walls(task, nodes))
        scene = SCENE.format(timestep=TIMESTEP, x=x, y=y, radius=DISC_RADIUS, blocks="".join(blocks), pegs=pegs)
        self.model = mujoco.MjModel.from_xml_string(scene)
        self.data = mujoco.MjData(self.model)
        mujoco.mj_forward(self.model, self.data)
        self._start, self._reference = position, position
        self._finger = self.model.geom("finger").id
        self._way_of_geom = {self.model.geom(f"block_{other}").id: other for other in task.ways}
        self._slide = self.data.joint(f"block_{way}").qpos
        self._bodies = [self.model.body(f"block_{other}").id for other in task.ways]

    @property
    def position(self) -> np.ndarray:
        """Where the finger is."""
        return self._start + self.data.qpos[:2]

    measured = position

    @property
    def gates(self) -> np.ndarray:
        """Where the blocks are."""
        return self.data.xpos[self._bodies, :2]

    @property
    def arrived(self) -> bool:
        """Whether the block that slides was pushed far enough."""
        return bool(self._slide[0] > FAR_ENOUGH)

    def move(self, target: np.ndarray, may_open: bool) -> int | None:
        """Moves towards a target for one control step; returns the way whose block is pressed on, if any."""
        goal = self.position + limited(target - self.position, MAX_PULL)
        before, self._reference = self._reference, self._reference + limited(goal - self._reference, MAX_STEP)
        for substep in range(1, SUBSTEPS + 1):
            self.data.ctrl = before + (self._reference - before) * substep / SUBSTEPS - self._start
            mujoco.mj_step(self.model, self.data)
        touched = {int(geom) for pair in self.data.contact.geom if self._finger in pair for geom in pair}
        return next((way for geom, way in self._way_of_geom.items() if geom in touched), None)


def walls(task: Task, nodes: np.ndarray) -> np.ndarray:
    """Where the pegs `(P, 2)` of the walls stand: around all corridors, as far from the middle as the finger needs."""
    tails, heads = nodes[list(task.tree.parents[1:])], nodes[1:]
    away = task.play + DISC_RADIUS + PEG_RADIUS
    turn = np.linspace(0, 2 * math.pi, 4 * math.ceil(away / PEG_RADIUS), endpoint=False)
    pegs = []
    for tail, head in zip(tails, heads, strict=True):
        x, y = (head - tail) / np.linalg.norm(head - tail)
        fractions = np.linspace(0, 1, math.ceil(np.linalg.norm(head - tail) / PEG_RADIUS))[:, None]
        sides = [tail + fractions * (head - tail) + side * away * np.array([-y, x]) for side in (-1, 1)]
        ends = [end + away * np.stack((np.cos(turn), np.sin(turn)), -1) for end in (tail, head)]
        pegs += [*sides, *ends]
    return np.array(
        [
            peg
            for peg in np.concatenate(pegs)
            if np.linalg.norm(peg - nearest_on_lines(peg, tails, heads), axis=1).min() > away - 1e-6
        ]
    )
