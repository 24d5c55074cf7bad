"""The file of a sweep: what it says, and what is refused."""

from pathlib import Path

import pytest

from lgmdjax.errors import InputError
from lgmdjax.sweeps import sweep_file

FILE = """
command = ["trial", "unseen"]
result = "*/trial/outcome.json"
measures = ["per_100_m.value"]
seeds = [3, 5]
[grid]
policy = ["learned", "blind"]
width = [80, 160]
"""


def written(folder: Path, text: str) -> Path:
    path = folder / "sweep.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_every_combination_runs_with_every_seed(tmp_path):
    sweep = sweep_file.read(written(tmp_path, FILE))
    lines = {" ".join(run.arguments(Path("o"))) for run in sweep.runs()}
    assert lines == {
        f"trial unseen --policy {policy} --width {width} --seed {seed} --out o"
        for policy in ("learned", "blind")
        for width in (80, 160)
        for seed in (3, 5)
    }
    assert len({run.name for run in sweep.runs()}) == 8
    assert sweep.varied() == ("policy", "width")


def test_listed_settings_may_have_different_flags(tmp_path):
    listed = '[[settings]]\npolicy = ["learned", "blind"]\n[[settings]]\noverlay = false\nvideo = true\n'
    sweep = sweep_file.read(written(tmp_path, FILE.partition("[grid]")[0] + listed))
    assert [run.arguments(Path("o"))[2:-4] for run in sweep.runs()][::2] == [
        ["--policy", "learned", "blind"],
        ["--no-overlay", "--video"],
    ]


def test_a_sweep_may_vary_seeds_only(tmp_path):
    sweep = sweep_file.read(written(tmp_path, FILE.partition("[grid]")[0]))
    assert [run.arguments(Path("o")) for run in sweep.runs()] == [
        ["trial", "unseen", "--seed", seed, "--out", "o"] for seed in ("3", "5")
    ]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('command = ["trial", "unseen"]', "", "expected in command a list of str, got None"),
        ('["trial", "unseen"]', '"trial"', "expected in command a list of str, got 'trial'"),
        ("[3, 5]", "[]", "expected in seeds a list of int"),
        ("[3, 5]", "[true]", "expected in seeds a list of int"),
        ("[3, 5]", "[3, 3]", "expected each of seeds once"),
        ("[3, 5]", "[-1]", "expected seeds of 0 or more"),
        ("policy =", "seed =", "neither out nor seed"),
        ("policy =", '"--policy" =', "expected flags without dashes"),
        ('"unseen"', '"--out=here"', "neither out nor seed"),
        ("[80, 160]", "80", "expected in .grid. a list"),
        ("[80, 160]", "[[1], {a = 1}]", "expected text, numbers or booleans"),
        ('"*/trial/outcome.json"', '"../other.json"', "expected in result the path"),
        ('"*/trial/outcome.json"', "3", "expected in result the path"),
        ("[grid]", "[gird]", "got gird"),
        ("[grid]", "[grid", "expected a sweep in TOML"),
        ("seeds = [3, 5]", "seeds = [3, 5]\nsettings = [{}]", "either .grid. or"),
    ],
)
def test_wrong_files_are_refused(tmp_path, old, new, message):
    with pytest.raises(InputError, match=message):
        sweep_file.read(written(tmp_path, FILE.replace(old, new)))


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(InputError, match="expected a sweep in TOML"):
        sweep_file.read(tmp_path / "none.toml")
