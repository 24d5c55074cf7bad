"""The report page: self-contained, made from the run's numbers, with a one-line error if a file is missing."""

import base64
import io
import json
import re
import shutil
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree

import av
import numpy as np
import pytest
import synthetic

from lgmdjax.errors import InputError
from lgmdjax.pipeline import report, report_data
from lgmdjax.reporting import walk_video
from lgmdjax.reporting.figures import style

VOID = {"meta", "link", "img", "br", "rect", "path"}


class Page(HTMLParser):
    """Parser of a page: its text, its attributes, and whether its tags are closed."""

    def __init__(self, source: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.attributes: list[tuple[str, str, str]] = []
        self.text_parts: list[str] = []
        self.feed(source)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.attributes += [(tag, name, value or "") for name, value in attrs]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.attributes += [(tag, name, value or "") for name, value in attrs]

    def handle_endtag(self, tag: str) -> None:
        assert self.open, f"</{tag}> closes nothing"
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if not {"style", "script"} & set(self.open):
            self.text_parts.append(data)

    @property
    def text(self) -> str:
        return re.sub(r"\s+", " ", " ".join(self.text_parts))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return synthetic.write_run(tmp_path_factory.mktemp("runs") / "made-up", frames=300, pixels=(60, 80))


@pytest.fixture(scope="module")
def source(run: Path) -> str:
    path = report.render(run, room=synthetic.room(), video_seconds=0.5)
    assert path == run / "report" / "index.html"
    return path.read_text(encoding="utf-8")


@pytest.fixture
def copy(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the run folder to change; video and figures are left out."""
    monkeypatch.setattr(walk_video, "write_trace", lambda *_, **__: 0)
    monkeypatch.setattr(style, "to_svg", lambda figure: b"")
    return shutil.copytree(run, tmp_path / "run", ignore=shutil.ignore_patterns("report"))


def rewrite(run: Path, name: str, **changes: object) -> None:
    path = run / name
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def text_of(run: Path) -> str:
    return Page(report.render(run, room=synthetic.room()).read_text(encoding="utf-8")).text


def inlined(source: str, kind: str) -> list[bytes]:
    return [base64.b64decode(code) for code in re.findall(rf'"data:{re.escape(kind)};base64,([^"]+)"', source)]


def test_the_page_is_self_contained(source: str):
    page = Page(source)
    assert not page.open, "a tag is not closed"
    assert "http://" not in source and "https://" not in source
    assert "<script" not in source and "@import" not in source
    addresses = [value for _, name, value in page.attributes if name in ("src", "href", "poster", "srcset", "data")]
    anchors = {value for _, name, value in page.attributes if name == "id"}
    assert len(addresses) > 10
    assert all(value.startswith("data:") or value.removeprefix("#") in anchors for value in addresses)
    assert set(re.findall(r"url\(([^)]*)\)", source)) == {"#tip"}


def test_all_figures_are_embedded_and_self_contained(source: str):
    pictures = inlined(source, "image/svg+xml")
    assert len(pictures) == 10
    for picture in pictures:
        root = ElementTree.fromstring(picture)
        links = [value for node in root.iter() for name, value in node.attrib.items() if name.endswith("href")]
        assert all(link.startswith(("#", "data:")) for link in links)
    described = [value for tag, name, value in Page(source).attributes if tag == "img" and name == "alt"]
    assert len(described) == 10 and all(described)


def test_the_video_plays(source: str):
    (content,) = inlined(source, "video/mp4")
    with av.open(io.BytesIO(content), "r") as container:
        stream = container.streams.video[0]
        assert stream.codec_context.name == "h264"
        assert stream.codec_context.pix_fmt == "yuv420p", "not playable in every browser"
        assert sum(1 for _ in container.decode(stream)) == round(0.5 * walk_video.VIDEO_RATE)


def test_numbers_come_from_the_run_folder(source: str):
    text = Page(source).text
    for expected in (
        "3.53 with the two LGMDs",
        "95 % interval 2.47 to 4.94",  # of the learned policy, in held-out rooms
        "seed 4711",
        "lgmdjax reproduce --scale quick --seed 4711",
        "0.9.2",
        "cpu, 2 cores",
        "12.5",
        "After 3.1 cycles",
        "0.0071 m/s where 0.05 is commanded",
        "At v = 1 it walks 0.049 m/s where 0.05 is commanded",
        "here 5 trials, 235.3 m in all, 8 collisions",
        "Each detector sees 60 % of the width of its camera's picture",
        "37 cm long and 45 cm wide",
        "drift in 25 s",
    ):
        assert expected in text


def test_other_numbers_give_another_page(copy: Path):
    held_out = {"unseen": {name: synthetic.score(rate) for name, rate in {"learned": 1.234, "blind": 43.21}.items()}}
    testing = json.loads((copy / "evaluate/evaluation.json").read_text())["testing"]
    (copy / "evaluate/evaluation.json").write_text(json.dumps({"testing": testing, **held_out}))
    rewrite(copy, "run.json", seed=8)
    text = text_of(copy)
    assert "1.23 with the two LGMDs" in text
    assert "43.2 when it walks straight on" in text
    assert "seed 8" in text and "4711" not in text


@pytest.mark.parametrize(
    ("learned", "blind", "interval", "expected"),
    [
        (3.0, 17.0, None, "less than half as often"),
        (9.0, 19.0, {"value": 11.0, "low": 10.0, "high": 12.0}, "at least half as often"),
        (12.0, 13.0, None, "no evidence that it learned"),
    ],
)
def test_the_verdict_follows_from_the_intervals(copy: Path, learned: float, blind: float, interval, expected: str):
    scores = {"learned": synthetic.score(learned), "blind": synthetic.score(blind)}
    scores["learned"]["per_100_m"] |= interval or {}
    rewrite(copy, "evaluate/evaluation.json", unseen=scores)
    assert expected in text_of(copy)


def test_versions_are_those_of_the_stages(copy: Path):
    rewrite(copy, "run.json", versions={"jax": "0.1.2"})
    assert "jax0.9.2" in text_of(copy).replace(" ", "")
    rewrite(copy, "train/done.json", versions={"jax": "0.9.9"})
    text = text_of(copy)
    assert "0.9.2 (fit-gait, collect, evaluate); 0.9.9 (train)" in text
    assert "0.1.2" not in text


def test_lost_robots_are_stated_where_they_were_counted(copy: Path):
    assert "lost" not in text_of(copy)
    rewrite(copy, "collect/calibration.json", lost=0)
    rewrite(copy, "train/training.json", lost=3)
    text = text_of(copy)
    assert "(none was lost)" in text
    assert "Of the robots that recorded these walks, 3 were lost:" in text


def test_a_rate_without_an_interval_has_a_dash(copy: Path):
    one = synthetic.score(3.0)
    one["clearance"] |= {"low": float("nan"), "high": float("nan")}
    rewrite(copy, "evaluate/evaluation.json", testing={name: one for name in synthetic.POLICY_NAMES})
    assert "0.31 – to –" in text_of(copy)


def test_names_and_texts_of_a_run_are_shown_as_text(copy: Path):
    """They are data: none becomes a tag, an attribute or a script of the page."""
    hostile = ["<script>alert(1)</script>", "\"><img src=x onerror='alert(1)'>", "line\nbreak\x1b[2J", "x" * 300]
    facts = json.loads((copy / "run.json").read_text())
    rewrite(
        copy, "run.json", scale=hostile[0], settings=facts["settings"] | {"report": dict.fromkeys(hostile, hostile[1])}
    )
    rewrite(copy, "train/done.json", device=hostile[1], versions={hostile[0]: hostile[1], "jax": hostile[3]})
    path = report.render(copy, room=synthetic.room())
    source = path.read_text(encoding="utf-8")
    page = Page(source)
    assert not page.open and "<script" not in source
    assert not any(name.startswith("on") or value == "x" for _, name, value in page.attributes)
    assert hostile[0] in page.text and hostile[3] in page.text


@pytest.mark.parametrize(
    ("name", "command"),
    [
        ("run.json", "reproduce"),
        ("fit-gait/gait.json", "fit-gait"),
        ("fit-gait/foot.npz", "fit-gait"),
        ("fit-gait/cpg.npz", "fit-gait"),
        ("collect/done.json", "collect"),
        ("collect/calibration.json", "collect"),
        ("train/training.json", "train"),
        ("train/prediction.npz", "train"),
        ("evaluate/evaluation.json", "evaluate"),
        ("evaluate/trajectories.npz", "evaluate"),
        ("evaluate/layers.npz", "evaluate"),
        ("evaluate/walk.npz", "evaluate"),
    ],
)
def test_a_missing_or_broken_file_names_the_stage_to_run(copy: Path, name: str, command: str):
    content = (copy / name).read_bytes()
    (copy / name).write_bytes(content[: len(content) // 2])
    with pytest.raises(InputError, match=f"cannot be read.*`lgmdjax {command}`"):
        report.render(copy, room=synthetic.room())
    (copy / name).unlink()
    with pytest.raises(InputError, match=f"found none; run `lgmdjax {command}`") as error:
        report.render(copy, room=synthetic.room())
    assert "\n" not in str(error.value)
    assert not (copy / "report").exists(), "a partial page was written"


def test_a_run_folder_without_an_expected_value_is_refused(copy: Path):
    gait = json.loads((copy / "fit-gait/gait.json").read_text())
    del gait["sway"]
    (copy / "fit-gait/gait.json").write_text(json.dumps(gait))
    with pytest.raises(InputError, match="of this version of lgmdjax"):
        report.render(copy, room=synthetic.room())
    assert not (copy / "report").exists()


def test_a_failure_leaves_the_last_page(copy: Path):
    page = report.render(copy, room=synthetic.room())
    before = page.read_bytes()
    (copy / "train/training.json").unlink()
    with pytest.raises(InputError):
        report.render(copy, room=synthetic.room())
    assert page.read_bytes() == before
    assert [path.name for path in page.parent.iterdir()] == ["index.html"]


def test_the_page_can_be_written_to_another_folder(copy: Path, tmp_path: Path):
    path = report.render(copy, tmp_path / "elsewhere", room=synthetic.room())
    assert path == tmp_path / "elsewhere" / "index.html"
    assert not (copy / "report").exists()
    assert "fit-gait12.5cpu" in Page(path.read_text(encoding="utf-8")).text.replace(" ", "")


def test_experiments_and_studies_have_sections_if_the_run_has_them(copy: Path):
    assert "experiments with obstacles" not in text_of(copy) and "Studies" not in text_of(copy)
    text = text_of(synthetic.write_experiments(copy))
    for expected in (
        "a single obstacle 15 of 15 29 of 30",
        "83 to 99 %",  # Wilson's interval of 29 in 30
        "The difference is largest at v = 5",
        "these velocities are not significantly worse (filled): 5.",
        "lstm, taught by 2a 3 270 6 2.22",
        "Printed equations against corrected ones",
        "White walls and corners",
        "How much may the parameters change?",
        "80 × 60 in the testing room",
    ):
        assert expected in text
    assert "320 × 240 in a single obstacle" not in text


def test_a_run_folder_of_version_0_1_0_gives_the_same_page(copy: Path):
    """Studies, settings and rows had other names. The listed settings are left out: they keep theirs."""
    present = without_settings(text_of(synthetic.write_experiments(copy)))
    former = {new: old for old, new in report_data.FORMER_NAMES.items()}

    def renamed(content):
        if isinstance(content, list):
            return [renamed(value) for value in content]
        if isinstance(content, dict):
            return {former.get(name, name): renamed(value) for name, value in content.items()}
        return content

    facts = json.loads((copy / "run.json").read_text())
    rewrite(copy, "run.json", settings=renamed(facts["settings"]))
    for study in report_data.STUDIES:
        rows = renamed(json.loads((copy / study / f"{study}.json").read_text()))
        folder = (copy / study).rename(copy / former.get(study, study))
        (folder / f"{study}.json").unlink()
        (folder / f"{folder.name}.json").write_text(json.dumps(rows))
    with np.load(copy / "evaluate" / "trajectories.npz") as arrays:
        contents = {name.replace("_resets", "_setbacks"): arrays[name] for name in arrays.files}
    np.savez(copy / "evaluate" / "trajectories.npz", allow_pickle=False, **contents)
    assert without_settings(text_of(copy)) == present


def without_settings(text: str) -> str:
    return text.partition("All settings")[0]
