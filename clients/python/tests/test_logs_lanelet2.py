"""Lanelet2 maps to map files: a miniature map, against PROJ, and read by the program."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
from logs_truth import Array, refused, run

ORIGIN = (49.0133, 8.4211, 115.0)
PLANE = pyproj.Transformer.from_pipeline(
    "+proj=pipeline +step +proj=cart +ellps=WGS84 +step +proj=topocentric +ellps=WGS84 "
    f"+lon_0={ORIGIN[1]} +lat_0={ORIGIN[0]} +h_0={ORIGIN[2]}"
)

WAYS = {
    "left": [(0, 2), (10, 2), (20, 2)],
    "right": [(20, -2), (0, -2)],  # The other direction: Lanelet2 turns it.
    "left2": [(20, 2), (40, 5)],
    "right2": [(20, -2), (40, 1)],
    "stop": [(0, 9), (1, 9)],
    "area": [(50, 0), (60, 0), (60, 9), (50, 0)],
    "back": [(0, 6), (20, 6)],
}
"""Lines by name. Points of one place are one node."""


def osm(path: Path, *, is_local: bool, change: tuple[str, str] = ("", "")) -> Path:
    places = sorted({point for points in WAYS.values() for point in points})
    ids = {point: str(100 + index) for index, point in enumerate(places)}
    text = "<?xml version='1.0'?>\n<osm version='0.6'>\n"
    for (x, y), name in ids.items():
        longitude, latitude, height = PLANE.transform(x, y, 0.5, direction="INVERSE")
        tags = f"<tag k='ele' v='{height if not is_local else 0.5}'/>"
        if is_local:
            tags += f"<tag k='local_x' v='{x}'/><tag k='local_y' v='{y}'/>"
        text += f"<node id='{name}' lat='{latitude:.12f}' lon='{longitude:.12f}'>{tags}</node>\n"
    for index, points in enumerate(WAYS.values()):
        text += f"<way id='{index}'>" + "".join(f"<nd ref='{ids[point]}'/>" for point in points) + "</way>\n"
    number = {name: index for index, name in enumerate(WAYS)}
    relations: list[tuple[str, dict[str, str], dict[str, str]]] = [
        ("1", {"left": "left", "right": "right"}, {"subtype": "road", "speed_limit": "36 km/h", "one_way": "no"}),
        ("2", {"left": "left2", "right": "right2"}, {"subtype": "road", "turn_direction": "left"}),
        # Its lines are the wrong way around: the lane goes to the west, with the line `left` on its left.
        ("3", {"left": "left", "right": "back"}, {"subtype": "bicycle_lane", "speed_limit": "20mph"}),
        ("4", {"left": "left2", "right": "right2"}, {"subtype": "crosswalk"}),
        ("5", {"ref_line": "stop"}, {"type": "regulatory_element", "subtype": "traffic_light"}),
        ("6", {"outer": "area"}, {"type": "multipolygon", "subtype": "parking"}),
    ]
    for name, members, tags in relations:
        lines = "".join(f"<member type='way' role='{role}' ref='{number[way]}'/>" for role, way in members.items())
        pairs = {"type": "lanelet", **tags}
        lines += "".join(f"<tag k='{key}' v='{value}'/>" for key, value in pairs.items())
        text += f"<relation id='{name}'>{lines}</relation>\n"
    text += "<relation id='7' action='delete'><tag k='type' v='lanelet'/><tag k='subtype' v='road'/></relation>\n"
    path.write_text((text + "</osm>\n").replace(*change) if change[0] else text + "</osm>\n")
    return path


def points(lane: dict[str, Any], name: str) -> Array:
    return np.array(lane[name])


@pytest.mark.parametrize("is_local", [True, False])
def test_lanes_and_areas(is_local: bool, tmp_path: Path) -> None:
    out = tmp_path / "map.json"
    origin = [] if is_local else ["--origin", ",".join(map(str, ORIGIN))]
    said = run(osm(tmp_path / "town.osm", is_local=is_local), *origin, "--out", out)
    assert "3 rows of lanes, 2 rows of areas" in said
    assert "relations regulatory_element traffic_light: 1" in said and "second directions of lanelets: 1" in said
    found = json.loads(out.read_text())
    one, two, three = found["lanes"]
    assert (one["next"], two["next"], three["next"]) == (["2"], [], [])
    assert one["limit_mps"] == pytest.approx(10) and two["intersection"] and three["kind"] == "bicycle"
    assert three["limit_mps"] == pytest.approx(8.9408)
    np.testing.assert_allclose(points(one, "left"), [[0, 2, 0.5], [10, 2, 0.5], [20, 2, 0.5]], atol=1e-6)
    np.testing.assert_allclose(points(one, "right"), [[0, -2, 0.5], [20, -2, 0.5]], atol=1e-6)
    np.testing.assert_allclose(points(one, "center"), [[0, 0, 0.5], [10, 0, 0.5], [20, 0, 0.5]], atol=1e-6)
    np.testing.assert_allclose(points(three, "left")[[0, -1]], [[20, 2, 0.5], [0, 2, 0.5]], atol=1e-6)
    np.testing.assert_allclose(points(three, "right"), [[20, 6, 0.5], [0, 6, 0.5]], atol=1e-6)
    assert sorted(area["kind"] for area in found["areas"]) == ["crosswalk", "drivable"]
    assert len(next(area for area in found["areas"] if area["kind"] == "drivable")["outline"]) == 3
    program = os.environ.get("WILDCITY_BIN")
    assert program, "set WILDCITY_BIN to the built wildcity binary"
    done = subprocess.run([program, "twin", "map", "check", str(out)], capture_output=True, text=True)
    assert done.returncode == 0 and "3 lanes, 2 areas" in done.stdout, done.stderr


BAD = {
    "no way": (("role='left' ref='0'", "role='left' ref='77'"), "relation 1: there is no way 77"),
    "no right line": (("role='right' ref='1'", "role='middle' ref='1'"), "without a left and a right line"),
    "no node": (("<node id='100'", "<node id='999'"), "there is no node 100"),
    "no number": (("k='ele' v='0.5'", "k='ele' v='high'"), "lacks a number"),
    "cut off": (("</osm>", ""), "not XML, or cut off"),
    "an unknown unit": (("36 km/h", "36 knots"), "speed_limit is '36 knots'"),
    "nothing": (("'lanelet'", "'other'"), "no lanelet of a known subtype"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_maps_are_refused(name: str, tmp_path: Path) -> None:
    change, words = BAD[name]
    source = osm(tmp_path / "town.osm", is_local=True, change=change)
    if name == "nothing":
        source.write_text(source.read_text().replace("'multipolygon'", "'other'"))
    assert words in refused(tmp_path, source)
    assert not list(tmp_path.glob("*.partial"))


def test_degrees_need_an_origin(tmp_path: Path) -> None:
    source = osm(tmp_path / "town.osm", is_local=False)
    assert "give the twin's origin with --origin" in refused(tmp_path, source)
    with pytest.raises(SystemExit) as stopped:
        run(source, "--out", tmp_path / "map.json", "--origin", "north")
    assert stopped.value.code == 2
