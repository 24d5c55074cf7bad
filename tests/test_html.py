"""Rich representations: what notebooks show of walks, rooms, outcomes and parameters."""

from dataclasses import dataclass
from html.parser import HTMLParser
from xml.etree import ElementTree

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import synthetic

import lgmdjax as lj
from lgmdjax import html
from lgmdjax.evaluation import metrics
from lgmdjax.simulation import assembly
from lgmdjax.simulation.closed_loop import Room
from lgmdjax.world import floor_plan

SVG = "{http://www.w3.org/2000/svg}"


class Cells(HTMLParser):
    """Collects the rows of all tables as lists of texts."""

    def __init__(self, text: str):
        super().__init__()
        self.rows: list[list[str]] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list) -> None:
        if tag == "tr":
            self.rows.append([])
        elif tag in ("td", "th"):
            self.rows[-1].append("")

    def handle_data(self, data: str) -> None:
        if self.rows and self.rows[-1]:
            self.rows[-1][-1] += data


def shown(thing: html.NotebookTable) -> dict[str, list[str]]:
    """Return value and comment of each row of a table by its name."""
    return {row[0]: row[1:] for row in Cells(thing._repr_html_()).rows}


@dataclass
class Inner(html.NotebookTable):
    x: float  # m, "quoted" & <escaped>
    flags: np.ndarray


@dataclass
class Outer(html.NotebookTable):
    """A tree."""

    inner: Inner
    weights: dict[str, np.ndarray]
    label: str = "a < b"  # one
    below: int = 3
    """Text below [s]."""


def test_a_tree_shows_values_and_the_comments_beside_its_fields():
    rows = shown(Outer(Inner(0.123456789, np.array([True, False] * 5)), {"w": np.arange(6.0).reshape(2, 3)}))
    assert rows["inner.x"] == ["0.123457", 'm, "quoted" & <escaped>']
    assert rows["inner.flags"] == ["bool[10]: 5 true", ""]
    assert rows["weights.w"] == ["float64[2, 3]: 0 to 5", ""]
    assert rows["label"] == ["a < b", "one"] and rows["below"] == ["3", "Text below [s]."]


def test_parameters_of_the_robot_are_shown_with_units():
    robot = assembly.load_robot()
    rows = shown(robot)
    threshold, row = float(robot.controller.detector.threshold), rows["controller.detector.threshold"]
    assert row[1] == "T_s, grey" and float(row[0]) == threshold
    assert rows["controller.detector_model"][0] == "lgmdjax.detectors.lgmd"
    assert len(rows) <= html.MAX_ROWS + 2
    assert shown(lj.lgmd.Params())["suppression"][1] == "T_f, grey"


def test_what_is_traced_or_random_is_shown_by_its_shape():
    found = []

    def trace(x: jax.Array) -> jax.Array:
        found.append(html._leaf(x))
        return x

    jax.jit(trace)(jnp.ones((2, 3), jnp.float32))
    assert found == ["float32[2, 3]"]
    assert html._leaf(jax.random.key(0)).startswith("key<")


def elements(svg: str, tag: str) -> list[ElementTree.Element]:
    return ElementTree.fromstring(svg).findall(f".//{SVG}{tag}")


def test_a_room_is_drawn_from_above():
    room = synthetic.room()
    svg = floor_plan.svg(room)
    walls, *boxes = elements(svg, "rect")
    assert [float(walls.attrib[name]) for name in ("x", "y", "width", "height")] == [-4, -4, 8, 8]
    assert len(boxes) == 3 and [box.attrib["fill"] == "none" for box in boxes] == [
        False,
        False,
        True,
    ]  # one is overhead
    assert boxes[0].attrib["transform"] == f"rotate({np.degrees(0.4):.2f} 2.000 1.000)"
    assert {float(disc.attrib["r"]) for disc in elements(svg, "circle")} == {0.2, 0.15}
    left, bottom, width, height = map(float, ElementTree.fromstring(svg).attrib["viewBox"].split())
    assert left < -4 and bottom < -4 and left + width > 4 and bottom + height > 4


def test_rooms_and_walks_have_pictures_and_tables():
    arenas = jax.tree.map(lambda leaf: jnp.stack([leaf] * 6), synthetic.room())
    rooms = Room(arena=arenas, starts=jnp.zeros((6, 1, 3)), key=jax.random.split(jax.random.key(0), 6))
    assert rooms._repr_html_().count("<svg") == 4
    one = jax.tree.map(lambda leaf: leaf[0], rooms)
    assert one._repr_html_().count("<svg") == one.arena._repr_html_().count("<svg") == 1
    record = synthetic.walk(2, 60)
    record.resets[0, 30:], record.contact[0, 29] = 1, True
    text = record._repr_html_()
    svg = text[text.index("<svg") : text.index("</svg>") + 6]
    assert len(elements(svg, "polyline")) == 3 and len(elements(svg, "path")) == 1  # three pieces, one contact
    assert shown(record)["clearance"] == ["float64[2, 60]: 0.3 to 0.3", "m, smallest within the frame"]
    assert "<svg" in jax.tree.map(lambda leaf: leaf[0], record)._repr_html_()


def test_outcomes_are_shown_with_their_intervals():
    score = metrics.score(synthetic.walk(2, 1200))
    rows = shown(score)
    assert rows["per_100_m"] == [str(score.per_100_m), "collisions per 100 m"]
    assert rows["progress.coverage"][1].startswith("1/min")


def test_a_room_without_source_is_shown_without_comments(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(html.inspect, "getsource", lambda kind: (_ for _ in ()).throw(OSError))
    html.comments.cache_clear()
    assert shown(Inner(1.0, np.zeros(1)))["x"] == ["1", ""]
    html.comments.cache_clear()
