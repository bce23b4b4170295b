"""A page of tables, pictures and videos in one HTML file that needs nothing else."""

import re
import tempfile
from base64 import b64encode
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from .rate_table import Table

TEMPLATE = "report.html.jinja"
PNG_START = b"\x89PNG\r\n\x1a\n"


@dataclass(frozen=True)
class Picture:
    """A PNG picture.

    Attributes:
        png (`bytes`): the file.
        text (`str`): what it shows, for those who cannot see it.
        caption (`str`): what one sees and what it means.
    """

    png: bytes
    text: str
    caption: str

    @property
    def source(self) -> str:
        """`str`: the file as a data URI."""
        return _data_uri("image/png", self.png)

    @property
    def size(self) -> tuple[int, int]:
        """`tuple[int, int]`: width and height in pixels, from the head of the file."""
        return int.from_bytes(self.png[16:20]), int.from_bytes(self.png[20:24])


@dataclass(frozen=True)
class Video:
    """An MP4 video.

    Attributes:
        mp4 (`bytes`): the file.
        poster (`Picture`): what is shown until it is played.
        caption (`str`): what one sees.
    """

    mp4: bytes
    poster: Picture
    caption: str

    @property
    def source(self) -> str:
        """`str`: the file as a data URI."""
        return _data_uri("video/mp4", self.mp4)


@dataclass(frozen=True)
class Note:
    """Something that there is not, and how to get it.

    Attributes:
        text (`str`): what is missing.
        command (`str`): what makes it; may be empty.
    """

    text: str
    command: str = ""


@dataclass
class Section:
    """A part of the page.

    Attributes:
        title (`str`): its heading.
        lead (`str`): what was measured and how to read it.
        tables (`list[Table]`): its tables.
        pictures (`list[Picture]`): its pictures, below the tables.
        videos (`list[Video]`): its videos, below the pictures.
        notes (`list[Note]`): what is missing.
    """

    title: str
    lead: str
    tables: list[Table] = field(default_factory=list)
    pictures: list[Picture] = field(default_factory=list)
    videos: list[Video] = field(default_factory=list)
    notes: list[Note] = field(default_factory=list)

    @property
    def anchor(self) -> str:
        """`str`: its id in the page."""
        return re.sub(r"\W+", "-", self.title.lower())


def read_picture(path: Path, text: str, caption: str) -> Picture:
    """Reads a picture.

    Args:
        path (`Path`):
            PNG file.
        text (`str`):
            See `Picture`.
        caption (`str`):
            See `Picture`.

    Returns:
        `Picture`: the picture.

    Raises:
        ValueError: If it is not a PNG file.
    """
    content = path.read_bytes()
    if not content.startswith(PNG_START) or len(content) < 24:
        raise ValueError(f"{path} is not a PNG picture: make it anew or remove it.")
    return Picture(content, text, caption)


def draw_picture(draw: Callable[[Path], None], text: str, caption: str) -> Picture:
    """Draws a picture that is kept nowhere else.

    Args:
        draw (`Callable[[Path], None]`):
            Writes it to a path.
        text (`str`):
            See `Picture`.
        caption (`str`):
            See `Picture`.

    Returns:
        `Picture`: the picture.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "picture.png")
        draw(path)
        return read_picture(path, text, caption)


def render(title: str, facts: dict[str, str], sections: Sequence[Section]) -> str:
    """The page as HTML; all text is escaped.

    Args:
        title (`str`):
            Its heading.
        facts (`dict[str, str]`):
            What was measured, when and with what.
        sections (`Sequence[Section]`):
            Its parts, each with another title.

    Returns:
        `str`: the page.
    """
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    return environment.get_template(TEMPLATE).render(title=title, facts=facts, sections=sections)


def _data_uri(media_type: str, content: bytes) -> str:
    return f"data:{media_type};base64,{b64encode(content).decode()}"
