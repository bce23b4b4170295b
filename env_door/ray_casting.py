"""Pictures without OpenGL: one ray a pixel with MuJoCo's own collision code, flat shading by surface normal."""

import numpy as np
from numpy.typing import NDArray

from env_door.simulator import mujoco

SKY = np.array([0.76, 0.82, 0.87])
LIGHT = np.array([-0.55, -0.5, 0.8]) / np.linalg.norm([-0.55, -0.5, 0.8])
FAR = 12.0


class RayCastRenderer:
    """Draws the visible geoms of a scene of primitive geoms on the CPU; takes what `make_renderer` takes."""

    def __init__(self, model: mujoco.MjModel, camera: str, size: int):
        self._model = model
        self._camera = int(model.camera(camera).id)
        self._size = size
        half = np.tan(np.deg2rad(model.cam_fovy[self._camera]) / 2)
        pixels = (np.arange(size) + 0.5) / size * 2 - 1
        right, down = np.meshgrid(pixels * half, pixels * half)
        directions = np.stack([right, -down, -np.ones_like(right)], axis=-1).reshape(-1, 3)
        self._directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
        material = model.geom_matid
        colours = np.where(material[:, None] >= 0, model.mat_rgba[np.maximum(material, 0)], model.geom_rgba)
        glow = np.where(material >= 0, model.mat_emission[np.maximum(material, 0)], 0.0)
        self._colours = np.vstack([colours[:, :3], SKY])
        self._glow = np.append(glow, 1.0)

    def draw(self, data: mujoco.MjData) -> NDArray[np.uint8]:
        """Picture of the state after `mujoco.mj_forward` or a step, shape `(size, size, 3)`."""
        count = self._size**2
        rotation = data.cam_xmat[self._camera].reshape(3, 3)
        rays = self._directions @ rotation.T
        geoms = np.full(count, -1, dtype=np.int32)
        normals = np.zeros(3 * count)
        mujoco.mj_multiRay(
            m=self._model,
            d=data,
            pnt=data.cam_xpos[self._camera],
            vec=rays.ravel(),
            geomgroup=np.ones(mujoco.mjNGROUP, dtype=np.uint8),
            flg_static=1,
            bodyexclude=-1,
            geomid=geoms,
            dist=np.zeros(count),
            normal=normals,
            nray=count,
            cutoff=FAR,
        )
        lit = np.clip(normals.reshape(-1, 3) @ LIGHT, 0.0, 1.0)
        brightness = np.minimum(0.65 + 0.45 * lit, 1.0)
        glow = self._glow[geoms]
        brightness = np.where(geoms < 0, 1.0, np.maximum(brightness, np.minimum(0.65 + glow, 1.0)))
        picture = self._colours[geoms] * brightness[:, None]
        return (picture * 255).astype(np.uint8).reshape(self._size, self._size, 3)

    def close(self) -> None:
        """Holds nothing that needs freeing."""
