"""`ufrnn report`: the tables, pictures and videos of a folder in one page that needs nothing else."""

from base64 import b64encode
from dataclasses import dataclass
from html import escape
from pathlib import Path
from string import Template

import pandas as pd

from ..analysis.results import WHAT_INTERVALS_ARE_OVER, rate_tables

PARTS = {
    "results.csv": (
        "Doors opened",
        "A door looks the same whichever way it opens, so that the first try is bound to be wrong in many trials: look "
        f"at whether they recover. {WHAT_INTERVALS_ARE_OVER}",
        "ufrnn results --trial_log=... --output_dir={folder}",
    ),
    "found_out.gif": (
        "A door that is found out",
        "What was tried so far stands below the picture, and when the policy was contradicted and went back.",
        "ufrnn video --policy_path=... --output={folder}/found_out.gif",
    ),
    "foresight.png": (
        "Imagined futures",
        "Top: what the camera saw, what the autoencoder keeps of it, and the image that ends each imagined future. "
        "Below: the joint that the futures disagree most about, and the predicted variance over the trial.",
        "ufrnn foresight --policy_path=... --output={folder}/foresight.png",
    ),
    "hidden.png": (
        "Hidden states",
        "Dotted: the demonstrations of each kind of door, which share one path up to the branch. Black: a trial. The "
        "circle is the first try, a square a further one, in the colour of that kind.",
        "ufrnn hidden --policy_paths=[...] --dataset_dir=... --output={folder}/hidden.png",
    ),
    "held.png": (
        "Hidden states while the door was held",
        "The yellow stretch is the time for which somebody held the door once it had begun to open.",
        "ufrnn hidden --policy_paths=[...] --dataset_dir=... --hold_seconds=5 --output={folder}/held.png",
    ),
    "lyapunov.png": (
        "Lyapunov exponents",
        "How fast imagined futures part that began with nearly the same hidden state: above 0 small noise grows, so "
        "that imagination explores; below 0 it dies out. Grey bars mark where phases of the task begin.",
        "ufrnn lyapunov --policy_paths=[...] --dataset_dir=... --output={folder}/lyapunov.png",
    ),
}
"""What the page shows, in this order: heading, what one sees, and the command that makes it."""

MEDIA = {".png": ("image/png", b"\x89PNG"), ".gif": ("image/gif", b"GIF8"), ".mp4": ("video/mp4", b"")}
"""Media type of a file, and how it begins."""

PAGE = Template("""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy"
  content="default-src 'none'; img-src data:; media-src data:; style-src 'unsafe-inline'">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>UF-RNN: $folder</title>
<style>
body { margin: 0 auto; padding: 1rem; max-width: 70rem; font: 1rem/1.5 system-ui, sans-serif; }
table { border-collapse: collapse; } th, td { padding: .3rem .8rem; border-bottom: 1px solid #ccc; text-align: right; }
div { overflow-x: auto; } img, video { max-width: 100%; }
</style>
</head>
<body>
<h1>UF-RNN: $folder</h1>
$parts
</body>
</html>
""")


@dataclass
class ReportConfig:
    """Puts what other commands left in a folder into one HTML file, and names what is missing."""

    folder: Path = Path("outputs/demo")
    """Folder with `results.csv`, pictures and a folder `videos`, such as that of `ufrnn demo`; `report.html` is written
    into it."""


def run(config: ReportConfig) -> None:
    """Writes the page."""
    if not config.folder.is_dir():
        raise FileNotFoundError(f"--folder: there is no folder '{config.folder}'.")
    parts = [_part(config.folder, name, *texts) for name, texts in PARTS.items()]
    if videos := sorted(config.folder.glob("videos/*.mp4")):
        parts.append("<h2>Videos of opened doors</h2>")
        parts += [f'<video controls src="{_data(video)}" title="{escape(video.name)}"></video>' for video in videos]
    output = config.folder / "report.html"
    output.write_text(PAGE.substitute(folder=escape(str(config.folder)), parts="\n".join(parts)))
    print(f"Report: {output} ({output.stat().st_size / 1e6:.1f} MB)")


def _part(folder: Path, name: str, heading: str, text: str, command: str) -> str:
    path, text = folder / name, escape(text)
    if not path.exists():
        content = f"There is no {escape(str(path))}; <code>{escape(command.format(folder=folder))}</code> makes it."
        return f"<h2>{heading}</h2>\n<p>{content}</p>"
    content = f"<div>{_tables(path)}</div>" if path.suffix == ".csv" else f'<img alt="{text}" src="{_data(path)}">'
    return f"<h2>{heading}</h2>\n<p>{text}</p>\n{content}"


def _tables(path: Path) -> str:
    try:
        tables = rate_tables(pd.read_csv(path, index_col="kind"))
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path} is no table of `ufrnn results` ({error}): make it anew or remove it.") from error
    return "\n".join(table.to_html() for table in tables)


def _data(path: Path) -> str:
    media_type, first_bytes = MEDIA[path.suffix]
    content = path.read_bytes()
    if not content.startswith(first_bytes):
        raise ValueError(f"{path} is no {media_type}: make it anew or remove it.")
    return f"data:{media_type};base64,{b64encode(content).decode()}"
