"""A moving picture of one trial, with what was tried and when the policy went back written below it."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from .picture import DOOR_COLORS
from .trial import TrialHistory

FRAMES_PER_SECOND = 10
SECONDS_AT_END = 3.0
NUM_COLORS = 128
BAR_HEIGHT, FONT_SIZE = 58, 16
WHITE, ALARM = "#ffffff", "#ff7777"


def captions(history: TrialHistory) -> list[str]:
    """What to write below each picture of a filmed trial."""
    tries, texts = dict(history.attempts), []
    text = "push, pull or slide?" if history.door_kind in ("push", "pull", "slide") else "which way?"
    for step in range(-1, len(history.states)):
        # The picture after a step is the first one that shows what became of it.
        if step in tries:
            text = f"tries to {tries[step]}"
        if step in history.returns:
            text = "contradicted: goes back"
        texts.append(text)
    return [*texts[:-1], "opened"] if history.success else texts


def annotate(history: TrialHistory) -> list[Image.Image]:
    """The pictures of a filmed trial, each with a bar below: its caption, the time, and all that was tried so far."""
    font = ImageFont.load_default(FONT_SIZE)
    pictures = []
    for number, (frame, caption) in enumerate(zip(history.film, captions(history), strict=True)):
        height, width, _ = frame.shape
        picture = Image.new("RGB", (width, height + BAR_HEIGHT))
        picture.paste(Image.fromarray(frame))
        draw, upper, lower = ImageDraw.Draw(picture), height + BAR_HEIGHT // 4, height + 3 * BAR_HEIGHT // 4
        draw.text((8, upper), caption, ALARM if "goes back" in caption else WHITE, font, anchor="lm")
        draw.text((width - 8, upper), f"{number / FRAMES_PER_SECOND:.1f} s", WHITE, font, anchor="rm")
        left = 8.0
        for way in [direction for step, direction in history.attempts if step < number]:
            right = left + draw.textlength(way, font) + 12
            draw.rectangle((left, lower - 11, right, lower + 11), fill=DOOR_COLORS[way])
            draw.text((left + 6, lower), way, WHITE, font, anchor="lm")
            left = right + 8
        pictures.append(picture)
    return pictures


def write_gif(pictures: Sequence[Image.Image], path: Path) -> None:
    """Writes an animation that rests at its end, then begins again."""
    sample = np.concatenate([np.asarray(picture) for picture in pictures[:: -(-len(pictures) // 12)]])
    palette = Image.fromarray(sample).quantize(NUM_COLORS)  # one for all, so that what stands still takes no space
    indexed = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
    milliseconds = [1000 // FRAMES_PER_SECOND] * (len(pictures) - 1) + [round(1000 * SECONDS_AT_END)]
    path.parent.mkdir(parents=True, exist_ok=True)
    indexed[0].save(path, save_all=True, append_images=indexed[1:], duration=milliseconds, loop=0)
