"""The parts of the report that show what is in the folder of results; each names what is missing and what makes it."""

from pathlib import Path

from . import success_curve
from .evaluation_table import InterferenceRow, ProtocolRow
from .rate_table import (
    INTERFERENCE_COLUMNS,
    SUCCESS_COLUMNS,
    interference_tables,
    read_rows,
    success_tables,
    summarize,
)
from .report_page import Note, Section, draw_picture, read_picture

SUCCESS_TABLE = "door_protocol.csv"
INTERFERENCE_TABLE = "door_interference.csv"
ABLATION_TABLE = "ablation.csv"
HIDDEN_PICTURE = "hidden.png"
HELD_PICTURE = "held.png"
EXPONENT_PICTURE = "lyapunov.png"
BRANCH_PICTURE = "foresight.png"
FILES = (
    SUCCESS_TABLE,
    INTERFERENCE_TABLE,
    ABLATION_TABLE,
    HIDDEN_PICTURE,
    HELD_PICTURE,
    EXPONENT_PICTURE,
    BRANCH_PICTURE,
)


def success(results_dir: Path) -> Section:
    """How many doors each model opened, and what it did after a wrong guess."""
    section = Section(
        "Success",
        "Rates are shares of simulated trials in percent, of each model at its last epoch and pooled over training "
        "seeds, with the 95 % Wilson interval in brackets and below as a bar. A door looks the same whichever way it "
        "opens, so that the first guess is bound to be wrong in many trials: what tells the models apart is whether "
        "they recover. Intervals take trials as independent; those of one training run have more in common than that, "
        "so look at the spread over training seeds below, too.",
    )
    path = results_dir / SUCCESS_TABLE
    if not path.exists():
        section.notes.append(_missing(path, "ufrnn protocol --models=[configs/ufrnn.yaml]"))
        return section
    section.tables = success_tables(read_rows(path, ProtocolRow, SUCCESS_COLUMNS))
    return section


def training(results_dir: Path) -> Section:
    """How success changed over training."""
    section = Section(
        "Success over training",
        "The more precisely a model follows its demonstrations, the less it may try anything else: success is shown "
        "over the epochs of training.",
    )
    path = results_dir / SUCCESS_TABLE
    if not path.exists():
        section.notes.append(_missing(path, "ufrnn protocol --models=[configs/ufrnn.yaml] --epochs=[100,1000]"))
        return section
    picture = draw_picture(
        lambda file: success_curve.draw(read_rows(path, ProtocolRow, SUCCESS_COLUMNS), file),
        "Success rate over the epochs of training, a panel for each model",
        "The areas are the doors of each kind that were opened within 30 s, as a share of all trials, so that their "
        "upper edge is the success rate; each thin line is one training seed. A band that is missing is a kind of door "
        "that the model does not open.",
    )
    section.pictures.append(picture)
    return section


def interference(results_dir: Path) -> Section:
    """What became of the doors that somebody held."""
    section = Section(
        "Interference",
        "Somebody on the other side holds the door still for a while once it has begun to open. A robot that takes "
        "every resistance for a wrong guess would now try another way; one that knows that the door has given way "
        "stays with it.",
    )
    path = results_dir / INTERFERENCE_TABLE
    if path.exists():
        section.tables = interference_tables(read_rows(path, InterferenceRow, INTERFERENCE_COLUMNS))
    else:
        section.notes.append(_missing(path, "ufrnn protocol --models=[configs/ufrnn.yaml] --hold_seconds=5"))
    _add_picture(
        section,
        results_dir / HELD_PICTURE,
        "Hidden states of a trial in which the door was held",
        "Hidden states on the plane of the demonstrations, as under “Hidden states” below; the yellow stretch is the "
        "time for which the door was held.",
        f"ufrnn hidden --policy_paths=[...] --dataset_dir=... --hold_seconds=5 --output={results_dir / HELD_PICTURE}",
    )
    return section


def ablation(results_dir: Path) -> Section:
    """What parts of the method contribute."""
    section = Section(
        "Ablations", "The same measurement with parts of the method left out or changed, one model for each change."
    )
    path = results_dir / ABLATION_TABLE
    if path.exists():
        rows = read_rows(path, ProtocolRow, SUCCESS_COLUMNS)
        section.tables.append(summarize(rows, SUCCESS_COLUMNS, "Doors opened, variant by variant"))
    else:
        section.notes.append(_missing(path, f"ufrnn protocol --models=[...] --results={path}"))
    return section


def hidden_states(results_dir: Path) -> Section:
    """What the models remember."""
    section = Section(
        "Hidden states",
        "What a model remembers, seen on the plane of largest variance (principal component analysis) of its shared "
        "hidden state along the demonstrations.",
    )
    _add_picture(
        section,
        results_dir / HIDDEN_PICTURE,
        "Hidden states along the demonstrations and in a trial, a panel for each model",
        "Dotted: the demonstrations of each kind of door, which share one path up to the branch. Black: a trial. The "
        "circle is the first try, a square a further one, in the colour of that kind. A path that leaves one branch "
        "for another is a robot that changes its mind.",
        f"ufrnn hidden --policy_paths=[...] --dataset_dir=... --output={results_dir / HIDDEN_PICTURE}",
    )
    return section


def exponents(results_dir: Path) -> Section:
    """How chaotic imagination is."""
    section = Section(
        "Lyapunov exponents",
        "The largest local Lyapunov exponent says how fast imagined futures part that began with nearly the same "
        "hidden state. Above 0 small noise grows, so that imagination explores; below 0 it dies out.",
    )
    _add_picture(
        section,
        results_dir / EXPONENT_PICTURE,
        "Largest Lyapunov exponent over the steps of the demonstrations, a curve for each model",
        "Mean and standard deviation over the demonstrations; grey bars mark where phases of the task begin. The doors "
        "part at the last one.",
        f"ufrnn lyapunov --policy_paths=[...] --dataset_dir=... --output={results_dir / EXPONENT_PICTURE}",
    )
    return section


def futures(results_dir: Path) -> Section:
    """What foresight imagines."""
    section = Section(
        "Imagined futures",
        "UF-RNN imagines what several candidates lead to: at every step those of a perturbed hidden state, of which it "
        "keeps the one whose future is least uncertain; with recall, when the joints contradict what it predicted, "
        "those that sense something other than expected, of which it tries the most determined one that is unlike any "
        "failed try. The autoencoder's decoder turns imagined features into images.",
    )
    _add_picture(
        section,
        results_dir / BRANCH_PICTURE,
        "Foresight at the branch of a trial: camera, imagined images, imagined joints and uncertainty",
        "Top: what the camera saw, what the autoencoder keeps of it, and the image that ends each imagined future. "
        "Below: the joint that the futures disagree most about, and the predicted variance over the trial.",
        f"ufrnn foresight --policy_path=... --output={results_dir / BRANCH_PICTURE}",
    )
    return section


def _missing(path: Path, command: str) -> Note:
    return Note(f"There is no {path}.", command)


def _add_picture(section: Section, path: Path, text: str, caption: str, command: str) -> None:
    if path.exists():
        section.pictures.append(read_picture(path, text, caption))
    else:
        section.notes.append(_missing(path, command))
