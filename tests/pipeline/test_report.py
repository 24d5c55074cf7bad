"""The report page: self-contained, made of the run's numbers, one clear line when something is missing."""

import base64
import io
import json
import re
import shutil
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree

import av
import pytest
import synthetic

from lgmdjax.errors import InputError
from lgmdjax.pipeline import report
from lgmdjax.reporting import walk_video
from lgmdjax.reporting.figures import style

VOID = {"meta", "link", "img", "br", "rect", "path"}


class Page(HTMLParser):
    """What a browser would see of a page: its text, its attributes, and whether its tags close."""

    def __init__(self, source: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.attributes: list[tuple[str, str, str]] = []
        self.words: list[str] = []
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
            self.words.append(data)

    @property
    def text(self) -> str:
        return re.sub(r"\s+", " ", " ".join(self.words))


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
    """A run folder to spoil; film and figures, which are not what is tested with it, are not written."""
    monkeypatch.setattr(walk_video, "write", lambda *args: 0)
    monkeypatch.setattr(style, "to_svg", lambda figure: b"")
    return shutil.copytree(run, tmp_path / "run", ignore=shutil.ignore_patterns("report"))


def rewrite(run: Path, name: str, **changes: object) -> None:
    path = run / name
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def text_of(run: Path) -> str:
    return Page(report.render(run, room=synthetic.room()).read_text(encoding="utf-8")).text


def inlined(source: str, kind: str) -> list[bytes]:
    return [base64.b64decode(code) for code in re.findall(rf'"data:{re.escape(kind)};base64,([^"]+)"', source)]


def test_the_page_needs_nothing_but_itself(source: str):
    page = Page(source)
    assert not page.open, "every tag is closed"
    assert "http://" not in source and "https://" not in source
    assert "<script" not in source and "@import" not in source
    addresses = [value for _, name, value in page.attributes if name in ("src", "href", "poster", "srcset", "data")]
    anchors = {value for _, name, value in page.attributes if name == "id"}
    assert len(addresses) > 10
    assert all(value.startswith("data:") or value.removeprefix("#") in anchors for value in addresses)
    assert set(re.findall(r"url\(([^)]*)\)", source)) == {"#tip"}


def test_all_figures_are_there_and_are_pictures_that_need_nothing(source: str):
    pictures = inlined(source, "image/svg+xml")
    assert len(pictures) == 9
    for picture in pictures:
        root = ElementTree.fromstring(picture)
        links = [value for node in root.iter() for name, value in node.attrib.items() if name.endswith("href")]
        assert all(link.startswith(("#", "data:")) for link in links)
    described = [value for tag, name, value in Page(source).attributes if tag == "img" and name == "alt"]
    assert len(described) == 9 and all(described)


def test_the_film_plays(source: str):
    (content,) = inlined(source, "video/mp4")
    with av.open(io.BytesIO(content), "r") as container:
        stream = container.streams.video[0]
        assert stream.codec_context.name == "h264"
        assert stream.codec_context.pix_fmt == "yuv420p", "what every browser plays"
        assert sum(1 for _ in container.decode(stream)) == round(0.5 * walk_video.RATE)


def test_numbers_come_from_the_files(source: str):
    text = Page(source).text
    for said in (
        "3.53 with the two locust cells",
        "95 % interval 2.47 to 4.94",  # the learned one, in unseen rooms
        "seed 4711",
        "lgmdjax reproduce --scale quick --seed 4711",
        "0.9.2",
        "cpu, 2 cores",
        "12.5",
        "After 3.1 cycles",
        "0.0071 m/s where 0.05 is asked",
        "At v = 1 it walks 0.049 m/s where 0.05 is asked",
        "here 5 trials, 235.3 m in all, 8 collisions",
        "each detector sees 60 % of its eye",
        "37 cm long and 45 cm wide",
        "drift in 25 s",
    ):
        assert said in text


def test_other_numbers_make_another_page(copy: Path):
    places = {"unseen": {name: synthetic.score(rate) for name, rate in {"learned": 1.234, "blind": 43.21}.items()}}
    testing = json.loads((copy / "evaluate/evaluation.json").read_text())["testing"]
    (copy / "evaluate/evaluation.json").write_text(json.dumps({"testing": testing, **places}))
    rewrite(copy, "run.json", seed=8)
    text = text_of(copy)
    assert "1.23 with the two locust cells" in text
    assert "43.2 when it walks straight on" in text
    assert "seed 8" in text and "4711" not in text


@pytest.mark.parametrize(
    ("learned", "blind", "said"),
    [
        (3.0, 17.0, "less than half as often"),
        (9.0, 19.0, "not proof"),
        (12.0, 13.0, "no proof that it learned to see"),
    ],
)
def test_the_verdict_is_what_the_intervals_say(copy: Path, learned: float, blind: float, said: str):
    scores = {"learned": synthetic.score(learned), "blind": synthetic.score(blind)}
    if said == "not proof":
        scores["learned"]["per_100_m"] |= {"value": 11.0, "low": 10.0, "high": 12.0}
        said = "not less than half as often"
    rewrite(copy, "evaluate/evaluation.json", unseen=scores)
    assert said in text_of(copy)


def test_versions_are_those_of_the_stages(copy: Path):
    rewrite(copy, "run.json", versions={"jax": "0.1.2"})
    assert "jax0.9.2" in text_of(copy).replace(" ", "")
    rewrite(copy, "train/done.json", versions={"jax": "0.9.9"})
    text = text_of(copy)
    assert "0.9.2 (fit-gait, collect, evaluate); 0.9.9 (train)" in text
    assert "0.1.2" not in text


def test_lost_robots_are_told_of_where_they_were_counted(copy: Path):
    assert "lost" not in text_of(copy)
    rewrite(copy, "collect/calibration.json", lost=0)
    rewrite(copy, "train/training.json", lost=3)
    text = text_of(copy)
    assert "(none was lost)" in text
    assert "Of the robots that walked for it, 3 were lost:" in text


def test_a_rate_without_an_interval_has_a_dash(copy: Path):
    one = synthetic.score(3.0)
    one["clearance"] |= {"low": float("nan"), "high": float("nan")}
    rewrite(copy, "evaluate/evaluation.json", testing={name: one for name in synthetic.DRIVERS})
    assert "0.31 – to –" in text_of(copy)


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
    assert not (copy / "report").exists(), "nothing half-written"


def test_a_run_of_another_version_is_refused(copy: Path):
    gait = json.loads((copy / "fit-gait/gait.json").read_text())
    del gait["sway"]
    (copy / "fit-gait/gait.json").write_text(json.dumps(gait))
    with pytest.raises(InputError, match="of this version of lgmdjax"):
        report.render(copy, room=synthetic.room())
    assert not (copy / "report").exists()


def test_an_old_page_stays_when_the_new_one_fails(copy: Path):
    page = report.render(copy, room=synthetic.room())
    before = page.read_bytes()
    (copy / "train/training.json").unlink()
    with pytest.raises(InputError):
        report.render(copy, room=synthetic.room())
    assert page.read_bytes() == before
    assert [path.name for path in page.parent.iterdir()] == ["index.html"]


def test_the_page_can_go_elsewhere(copy: Path, tmp_path: Path):
    path = report.render(copy, tmp_path / "elsewhere", room=synthetic.room())
    assert path == tmp_path / "elsewhere" / "index.html"
    assert not (copy / "report").exists()
    assert "fit-gait12.5cpu" in Page(path.read_text(encoding="utf-8")).text.replace(" ", "")


def test_experiments_and_studies_have_their_sections_where_there_are_some(copy: Path):
    assert "experiments with obstacles" not in text_of(copy) and "Studies" not in text_of(copy)
    text = text_of(synthetic.write_experiments(copy))
    for said in (
        "a single obstacle 15 of 15 29 of 30",
        "83 to 99 %",  # Wilson's interval of 29 in 30
        "furthest apart at v = 5",
        "lstm, taught by 2a 3 270 6 2.22",
        "As printed against corrected",
        "How far may things be from what was chosen?",
        "80 × 60 in the testing room",
    ):
        assert said in text
    assert "320 × 240 in a single obstacle" not in text
