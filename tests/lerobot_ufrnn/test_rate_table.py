from dataclasses import replace

import pytest

from lerobot_ufrnn.analysis import success_curve
from lerobot_ufrnn.analysis.evaluation_table import InterferenceRow, ProtocolRow, read_table, rows_of, to_csv
from lerobot_ufrnn.analysis.rate_table import MINUS, interference_tables, success_tables
from lerobot_ufrnn.analysis.results import DoorResult
from lerobot_ufrnn.analysis.success_curve import draw
from lerobot_ufrnn.commands import main
from lerobot_ufrnn.experiments.chain import add_to_table

HEADER = "model,train_seed,epoch,kind,trials,opened_150,opened_300,first_try_wrong,recovered"
ROW = ProtocolRow("ufrnn", 0, 100, "pull", 10, 3, 5, 6, 2)
HELD_HEADER = "model,train_seed,epoch,kind,trials,held,opened_after_hold,tried_another_way"
HELD_ROW = InterferenceRow("ufrnn", 0, 100, "pull", 10, 8, 6, 4)


def results(model: str, epochs=(100, 200), seeds=(0, 1), opened=(9, 5, 1)) -> list[ProtocolRow]:
    return [
        ProtocolRow(model, seed, epoch, kind, 10, number // 2, number, 4, 2)
        for seed in seeds
        for epoch in epochs
        for kind, number in zip(("push", "pull", "slide"), opened, strict=True)
    ]


def test_a_row_a_door_and_none_for_all():
    doors = [DoorResult(kind, 10, 3, 5, 3, 6, 2, 1, 8, 6, 4) for kind in ("pull", "all")]
    assert rows_of(ProtocolRow, "ufrnn", 0, 100, doors) == [ROW]
    assert rows_of(InterferenceRow, "ufrnn", 0, 100, doors) == [HELD_ROW]


def test_rows_are_merged_by_key_and_sorted(tmp_path):
    table = tmp_path / "results" / "table.csv"
    add_to_table(table, [ROW, replace(ROW, model="act")])
    add_to_table(table, [replace(ROW, opened_300=9), replace(ROW, epoch=20)])
    assert table.read_text().splitlines() == [
        HEADER,
        "act,0,100,pull,10,3,5,6,2",
        "ufrnn,0,20,pull,10,3,5,6,2",
        "ufrnn,0,100,pull,10,3,9,6,2",
    ]
    assert [path.name for path in table.parent.iterdir() if path.suffix != ".lock"] == ["table.csv"]


def test_a_table_is_read_as_it_was_written(tmp_path):
    path = tmp_path / "table.csv"
    path.write_text(to_csv(results("ufrnn")))
    assert sorted(read_table(path, ProtocolRow), key=repr) == sorted(results("ufrnn"), key=repr)
    path.write_text(to_csv([HELD_ROW]))
    assert path.read_text() == f"{HELD_HEADER}\nufrnn,0,100,pull,10,8,6,4\n"
    assert read_table(path, InterferenceRow) == [HELD_ROW]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "first line must be model,"),
        ("model,kind\n", "first line must be model,"),
        (f"{HELD_HEADER}\nufrnn,0,100,pull,10,8,6,4\n", f"first line must be {HEADER}"),
        (f"{HEADER}\nufrnn,0,100,pull,10,3,5,6,x\n", "line 2 is no row"),
        (f"{HEADER}\nufrnn,0,100,pull,10,3,5,6\n", "line 2 is no row"),
    ],
)
def test_another_table_is_refused(tmp_path, text, message):
    (tmp_path / "table.csv").write_text(text)
    with pytest.raises(ValueError, match=message):
        read_table(tmp_path / "table.csv", ProtocolRow)


def test_rows_of_interference_are_not_mixed_with_others(tmp_path):
    add_to_table(tmp_path / "table.csv", [ROW])
    with pytest.raises(ValueError, match=f"first line must be {HELD_HEADER}"):
        add_to_table(tmp_path / "table.csv", [HELD_ROW])


def test_the_summary_of_interference_counts_held_doors_only():
    rows = [HELD_ROW, replace(HELD_ROW, train_seed=1, kind="push", held=0, opened_after_hold=0, tried_another_way=0)]
    models, doors = (table.to_markdown() for table in interference_tables([*rows, replace(HELD_ROW, epoch=20)]))
    held, opened, tried = "8/20 = 40% [22%, 61%]", "6/8 = 75% [41%, 93%]", "4/8 = 50% [22%, 78%]"
    assert models.splitlines()[4:] == [f"| ufrnn | {held} | {opened} | {tried} | 100 | 2 |"]
    assert doors.splitlines()[4:] == [
        f"| ufrnn | pull | 8/10 = 80% [49%, 94%] | {opened} | {tried} | 100 | 1 |",
        "| ufrnn | push | 0/10 = 0% [0%, 28%] | - | - | 100 | 1 |",
    ]


def test_the_summary_pools_seeds_at_the_last_epoch_and_compares_models():
    rows = [*results("ufrnn"), *results("act", epochs=(7,), opened=(1, 0, 2))]
    models, differences, doors = (table.to_markdown() for table in success_tables(rows))
    assert "| ufrnn | 30/60 = 50% [38%, 62%] | 12/24 = 50% [31%, 69%] |" in models
    assert models.splitlines()[-1].endswith("| 12/60 = 20% [12%, 32%] | 200 | 2 |")
    assert "| act | 6/60 = 10%" in models
    assert f"| ufrnn {MINUS} act | +40 [+24, +53] |" in differences
    assert "| ufrnn | slide | 2/20 = 10% [3%, 30%] |" in doors


def test_one_model_differs_from_none():
    assert [table.columns[0] for table in success_tables(results("ufrnn"))] == ["model", "model"]


def test_a_single_epoch_is_no_curve_beside_others(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(success_curve, "_draw_model", lambda panel, rows: drawn.extend({row.model for row in rows}))
    once, twice = results("once", epochs=(100,)), results("twice", epochs=(100, 200))
    draw([*once, *twice], tmp_path / "curve.png")
    draw(once, tmp_path / "curve.png")
    assert drawn == ["twice", "once"]


@pytest.mark.parametrize("epochs", [(100,), (100, 200, 500)])
def test_the_curve_is_drawn(tmp_path, epochs):
    table, picture = tmp_path / "table.csv", tmp_path / "pictures" / "curve.png"
    rows = [*results("ufrnn", epochs), *results("act", (3,), seeds=(5,))]
    table.write_text(to_csv(rows))
    assert main(["curve", f"--results={table}", f"--output={picture}"]) == 0
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_a_seed_without_some_epochs_is_drawn(tmp_path):
    draw([*results("ufrnn", seeds=(0,)), *results("ufrnn", epochs=(100,), seeds=(1,))], tmp_path / "curve.png")
    assert (tmp_path / "curve.png").exists()


def test_without_results_there_is_no_curve(tmp_path, capsys):
    table = tmp_path / "table.csv"
    assert main(["curve", f"--results={table}"]) == 1
    assert "`ufrnn protocol` makes one" in capsys.readouterr().err
    table.write_text(HEADER + "\n")
    assert main(["curve", f"--results={table}"]) == 1
    assert "the table is empty" in capsys.readouterr().err
