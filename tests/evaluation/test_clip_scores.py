"""Alarms on labelled clips: what counts as a hit, how constants are chosen, labels, and the command on small films."""

import csv
import json
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from lgmdjax.cli import main
from lgmdjax.detectors import alarm
from lgmdjax.errors import InputError
from lgmdjax.evaluation import clip_labels, clip_scores
from lgmdjax.evaluation.clip_labels import Label
from lgmdjax.reporting import video_io

RATE = 10.0  # frames a second of the made-up responses


def series(response, kind="none", contact=None, clip="a.mp4"):
    response = np.asarray(response, float)
    label = Label(clip=clip, kind=kind, contact=contact)
    return clip_scores.Series(label, RATE, np.arange(len(response)) / RATE, response)


def pulses(*seconds, length=6.0, height=0.9):
    """Return a response of 0.5 that is higher for 0.3 s from each of some times on."""
    response = np.full(round(length * RATE), 0.5)
    for start in seconds:
        response[round(start * RATE) : round(start * RATE) + 3] = height
    return response


def outcome(each, threshold=0.8, persistence=0.0):
    return clip_scores.score_fixed([each], clip_scores.Setting(threshold, persistence))


@pytest.mark.parametrize(
    ("starts", "kind", "contact", "hits", "false_alarms", "lead"),
    [
        ((3.6,), "collision", 4.0, 1, 0, 0.4),
        ((2.5, 3.6), "collision", 4.0, 1, 0, 1.5),  # the first one in the window
        ((2.1,), "collision", 4.0, 0, 1, np.nan),  # too early
        ((2.4,), "collision", 4.0, 1, 1, 1.5),  # it begins too early, and is still there
        ((4.1,), "collision", 4.0, 1, 0, -0.1),  # as exact as labels are
        ((4.3, 5.0), "collision", 4.0, 0, 0, np.nan),  # after contact nothing counts
        ((1.0, 3.0), "none", None, 0, 2, np.nan),
        ((1.0,), "approach", None, 1, 0, np.nan),  # anywhere
        ((), "recede", None, 0, 0, np.nan),
    ],
)
def test_what_counts(starts, kind, contact, hits, false_alarms, lead):
    if kind in clip_labels.APPROACHING:
        scores = outcome(series(pulses(*starts), kind, contact))
        assert scores["approaches"] == 1 and scores["hits"] == hits
    else:
        other = clip_scores.count(series(pulses(*starts), kind), np.asarray([0.8]), (0.0,))
        assert other.false_alarms[0, 0] == false_alarms and other.minutes == pytest.approx(0.1)
        return
    assert scores["false_alarms"] == false_alarms
    assert scores["lead"]["value"] == pytest.approx(lead, nan_ok=True)
    assert scores["minutes"] == pytest.approx(0.0 if contact is None else 2.5 / 60)


def test_an_alarm_begins_in_the_last_of_the_frames_that_it_needs():
    """As in `alarm.step`: 0.2 s at 10 frames a second are two frames."""
    each = series(pulses(1.0, 3.0))
    assert clip_scores.alarm_onsets(each, clip_scores.Setting(0.8, 0.0)) == [1.0, 3.0]
    assert clip_scores.alarm_onsets(each, clip_scores.Setting(0.8, 0.2)) == [1.1, 3.1]
    assert clip_scores.alarm_onsets(each, clip_scores.Setting(0.8, 0.4)) == []
    short_gap = series(pulses(1.0, 1.6, 3.0))
    assert clip_scores.alarm_onsets(short_gap, clip_scores.Setting(0.8, 0.0)) == [1.0, 3.0]


def made_up_clips():
    """Return clips in which the truth is above 0.75, and one louder false alarm that is too short."""
    approaching = [series(pulses(3.5, height=0.8 + 0.02 * k), "collision", 4.0, f"c{k}.mp4") for k in range(4)]
    others = [series(pulses(2.0, height=0.7), clip=f"n{k}.mp4") for k in range(3)]
    spike = np.where(np.arange(60) == 30, 0.95, 0.5)
    return [*approaching, *others, series(spike, clip="spike.mp4")]


def test_threshold_and_persistence_are_chosen_on_other_clips():
    scores = clip_scores.score(made_up_clips())
    setting = scores["setting"]
    assert 0.7 < setting["threshold"] <= 0.8 and setting["persistence"] > 0  # 0.2 s pass over the spike
    for scheme in ("leave_one_out", "halves"):
        assert scores[scheme]["hits"] == 4
    assert scores["halves"]["false_alarms"] <= 1  # one half has not seen the spike
    assert scores["leave_one_out"]["false_alarms"] == 1  # the spike, by what was chosen without it
    assert scores["peaks_at_contact"] == 0 and scores["contacts"] == 4  # 3.5 s is not within 0.4 s of 4.0


def test_area_under_roc_compares_windows_with_stretches():
    clips = made_up_clips()
    stretches = 4 * 2 + 4 * 4  # of 2.5 s before the windows, and of 6 s
    assert clip_scores.area(clips) == pytest.approx((4 * (stretches - 1)) / (4 * stretches))  # only the spike is above


def test_halves_have_as_many_approaches():
    labels = [each.label for each in made_up_clips()]
    first, second = clip_scores.split_halves(labels)
    assert sorted(first + second) == list(range(8))
    assert sum(labels[k].is_approach for k in first) == sum(labels[k].is_approach for k in second) == 2


def test_one_approach_is_too_few_to_choose_by():
    with pytest.raises(InputError, match="two clips or more that approach"):
        clip_scores.score([series(pulses(3.5), "collision", 4.0), series(pulses())])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("clip,kind\na.mp4,none\n", "contact_s"),
        ("clip,kind,contact_s\n", "no row"),
        ("clip,kind,contact_s\na.mp4,none,1.0\n", "line 2: expected no contact_s for kind 'none'"),
        ("clip,kind,contact_s\na.mp4,collision,soon\n", "line 2: expected seconds.*soon"),
        ("clip,kind,contact_s\na.mp4,collision,-1\n", "expected seconds.*-1"),
        ("clip,kind,contact_s\na.mp4,,\n", "a clip and its kind"),
        ("clip,kind,contact_s\na.mp4,none,\na.mp4,none,\n", "got a.mp4 twice"),
        ("clip,kind,contact_s\n" + 2 * "".join(f"{k}.mp4,none,\n" for k in range(3000)), "0.mp4 and others twice"),
        ("clip,kind,contact_s\n../a.mp4,none,\n", "a clip in the folder of the videos"),
        ("clip,kind,contact_s\n/etc/passwd,none,\n", "a clip in the folder of the videos"),
        ("clip,kind,contact_s\na/../../b,none,\n", "a clip in the folder of the videos"),
        (None, "got no such file"),
    ],
)
def test_labels_that_contradict_themselves_are_refused(tmp_path, text, words):
    if text is not None:
        (tmp_path / "labels.csv").write_text(text)
    with pytest.raises(InputError, match=words):
        clip_labels.read_labels(tmp_path / "labels.csv")


def _change(params, state, frame):
    excitation = jnp.mean(jnp.abs(frame - state))
    return frame, SimpleNamespace(u=0.5 + 0.5 * jnp.tanh(excitation), excitation=excitation)


change = SimpleNamespace(Params=lambda: (), init=lambda params, frame: frame, step=_change)
"""A detector that answers to any change, found by `test_clip_scores:change`."""


def growing(frames=45):
    """Return frames of a dark square on coarse noise, which grows until it fills the picture."""
    noise = np.random.default_rng(0).integers(100, 180, (6, 8), np.uint8).repeat(8, 0).repeat(8, 1)
    film = np.stack([noise] * frames)
    for k in range(frames):
        half = min(int(1 + 2.0 / (1.02 - k / frames)), 24)
        film[k, 24 - half : 24 + half, 32 - half : 32 + half] = 20
    return film


HOSTILE = "<script>alert('$\\x$')\n\"{}\x1b[2J" + "d" * 180 + ".mp4"  # a name that a file may have


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder of four small films with their labels, and one film more."""
    folder = tmp_path_factory.mktemp("films")
    film = growing()
    films = {"a.mp4": film, "b.mp4": film[:, :, ::-1], "c.mp4": film[::-1], HOSTILE: film[::-1, ::-1], "e.mp4": film}
    for name, frames in films.items():
        with video_io.open_writer(folder / name, 64, 48, 30, fast=True) as write:
            for grey in frames:
                write(np.ascontiguousarray(grey)[..., None].repeat(3, axis=-1))
    rows = [("a.mp4", "collision", "1.5", "<b>grows</b>"), ("b.mp4", "approach", "", ""), ("c.mp4", "recede", "", "")]
    with (folder / "labels.csv").open("w", newline="") as file:
        csv.writer(file).writerows([(*clip_labels.COLUMNS, "what"), *rows, (HOSTILE, "shrinks", "", "")])
    return folder


def test_the_command_writes_page_tables_and_responses(folder, tmp_path, capsys):
    flags = ["--detector", "test_clip_scores:change", "--out", str(tmp_path)]
    assert main.main(["bench", "clips", str(folder), str(folder / "labels.csv"), *flags]) == 0
    told = capsys.readouterr()
    assert "note: no label for e.mp4" in told.err and "note: clips of kind shrinks" in told.err
    out = tmp_path / f"clips-{folder.name}"
    assert told.out.split("\n")[1] == str(out / "index.html")
    (row,) = json.loads((out / "scores.json").read_text())["rows"]
    assert row["detector"] == "test_clip_scores:change" and row["clips"] == ["a.mp4", "b.mp4", "c.mp4", HOSTILE]
    assert row["adapted"]["auc"] == 1 and row["adapted"]["fixed"]["hits"] == 2
    assert row["adapted"]["fixed"]["false_alarms"] == 0 and row["adapted"]["leave_one_out"]["hits"] == 2
    page = (out / "index.html").read_text()
    assert "&lt;b&gt;grows&lt;/b&gt;" in page and "<b>grows" not in page  # labels are text
    assert "<script" not in page and "&lt;script&gt;" in page and "\x1b" not in told.err
    assert page.count("data:image/png;base64,") == 5 and "http" not in page.replace("data:", "")  # self-contained
    assert (out / "scores.md").read_text().count("\n") == 3
    check_responses(out / "responses.csv", folder)


def check_responses(path, folder):
    """Compare excitation and adapted response of a clip with `alarm` run on the frames of the video, step by step."""
    with path.open() as file:
        rows = [row for row in csv.DictReader(file) if row["clip"] == "a.mp4"]
    with video_io.open_reader(folder / "a.mp4") as video:
        frames = np.stack([frame.picture for frame in video.frames(64, 48)]).astype(float)
    excitation = np.abs(np.diff(frames, axis=0)).mean((1, 2))
    np.testing.assert_allclose([float(row["excitation"]) for row in rows], [0.0, *excitation], rtol=1e-5)
    blocks = frames.reshape(-1, 12, 4, 16, 4).mean((2, 4))
    changed = np.diff(blocks, axis=0)
    decay, slow = np.exp(-1 / 30 / 0.3), np.exp(-1 / 30 / alarm.Params.slow)
    assert np.abs(changed).mean((1, 2)).min() > alarm.STILL or len(excitation) == 44
    moved = np.abs(changed).mean((1, 2)) > alarm.STILL
    shift, size = np.median(changed, axis=(1, 2))[moved], np.abs(changed).mean((1, 2))[moved]

    def mean(values, factor):
        return [np.average(values[: k + 1], weights=factor ** np.arange(k + 1)[::-1]) for k in range(len(values))]

    whole_field = np.minimum(np.abs(mean(shift, decay)) / mean(size, decay), 1)
    fast, long = (np.asarray(mean(excitation[moved] * (1 - whole_field), factor)) for factor in (decay, slow))
    seen = np.asarray([float(row["adapted"]) for row in rows])[1:][moved]
    np.testing.assert_allclose(seen, fast / (fast + long), rtol=1e-4)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "got 0 paths"),
        (["no/folder"], "found none at no/folder"),
        (["{folder}", "--detector", "eta"], "which is given the geometry"),
        (["{folder}", "--detector", "lgmd3"], "a detector among lgmd, "),
        (["{folder}", "{folder}/other.csv"], "got no such file"),
    ],
)
def test_wrong_arguments_are_one_line(folder, arguments, words, capsys):
    assert main.main(["bench", "clips", *(word.format(folder=folder) for word in arguments)]) == 2
    line = capsys.readouterr().err.strip().splitlines()[-1]
    assert line.startswith("lgmdjax: ") and words in line


def test_a_contact_after_the_end_and_a_missing_clip_are_refused(folder, tmp_path, capsys):
    for row, words in (("a.mp4,collision,9.0", "ends at 1.47 s"), ("z.mp4,none,", "found no z.mp4")):
        labels = tmp_path / "labels.csv"
        labels.write_text(f"clip,kind,contact_s\n{row}\n")
        flags = ["--detector", "test_clip_scores:change", "--out", str(tmp_path / "out")]
        assert main.main(["bench", "clips", str(folder), str(labels), *flags]) == 2
        assert words in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
