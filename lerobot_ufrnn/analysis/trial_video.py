"""A video of one trial, with the time and what was tried so far written above each frame."""

from collections.abc import Iterable, Sequence
from io import BytesIO

import av
import cv2
import numpy as np
from matplotlib.colors import to_rgb
from numpy.typing import NDArray

from .colors import DOOR_COLORS
from .trial import TrialHistory

FRAMES_PER_SECOND = 10
BAR_HEIGHT = 48
WHITE = "#eeeeee"


def annotate(frames: Iterable[NDArray[np.uint8]], history: TrialHistory) -> list[NDArray[np.uint8]]:
    """Adds a bar with step, time and attempts so far above each frame, where no player puts its controls.

    Args:
        frames (`Iterable[NDArray[np.uint8]]`):
            Pictures of the trial, from before its first step to after its last, (height, width, 3).
        history (`TrialHistory`):
            The trial.

    Returns:
        `list[NDArray[np.uint8]]`: the frames, `BAR_HEIGHT` higher.
    """
    annotated = []
    for number, frame in enumerate(frames):
        picture = np.pad(frame, ((BAR_HEIGHT, 0), (0, 0), (0, 0)))
        lines = [[(f"step {number}", WHITE), (f"{number / FRAMES_PER_SECOND:.1f} s", WHITE)], [("tried:", WHITE)]]
        if history.success and number == len(history.states):
            lines[0].append(("opened", DOOR_COLORS[history.door_kind]))
        lines[1] += [(way, DOOR_COLORS[way]) for step, way in history.attempts if step < number]
        for line, words in enumerate(lines):
            left = 6
            for word, color in words:
                corner = (left, 18 + 21 * line)
                rgb = [255 * value for value in to_rgb(color)]
                cv2.putText(picture, word, corner, cv2.FONT_HERSHEY_SIMPLEX, 0.5, rgb, 1, cv2.LINE_AA)
                left += cv2.getTextSize(word, cv2.FONT_HERSHEY_SIMPLEX, 0.5, 1)[0][0] + 10
        annotated.append(picture)
    return annotated


def encode(frames: Sequence[NDArray[np.uint8]]) -> bytes:
    """An MP4 file (H.264) that browsers play.

    Args:
        frames (`Sequence[NDArray[np.uint8]]`):
            Its frames, (height, width, 3), of even height and width.

    Returns:
        `bytes`: the file.
    """
    file = BytesIO()
    height, width, _ = frames[0].shape
    with av.open(file, "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=FRAMES_PER_SECOND, options={"crf": "26"})
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode())
    return file.getvalue()
