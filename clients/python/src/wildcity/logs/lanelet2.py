"""Lanelet2 maps (OSM XML) as map files of a twin: https://github.com/fzi-forschungszentrum-informatik/Lanelet2 (docs).

A way is a line string; a relation of type `lanelet` has the members `left` and `right`; a relation of type
`multipolygon` has members `outer`. Positions of nodes are the tags `local_x`, `local_y` and `ele` if they have them
(Autoware), else latitude and longitude, which become x east, y north, z up on the tangent plane (WGS84) of the origin.

This kind makes a map file, not a log: OUT is a JSON file that `wildcity twin map check` and scenarios read.
"""

from __future__ import annotations

import json
import os
from collections import Counter
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from .earth import earth_centred, tangent_plane
from .errors import LogError
from .frames import Matrix
from .kinds import Options
from .maps import MapBuilder
from .progress import Progress
from .tableio import require
from .writer import Report

_LANES = {
    "road": "driving", "highway": "driving", "play_street": "driving", "emergency_lane": "other",
    "bus_lane": "driving", "bicycle_lane": "bicycle", "walkway": "sidewalk", "shared_walkway": "sidewalk",
    "road_shoulder": "other", "pedestrian_lane": "sidewalk", "exit": "driving",
}  # fmt: skip
"""Subtypes of lanelets, and the users of our lanes. `crosswalk` is an area; others are left out."""

_AREAS = {"parking": "drivable", "keepout": None, "freespace": "drivable", "intersection_area": "intersection"}


def logs(source: Path) -> list[str]:
    """A map is no log; it has one name."""
    return [source.stem]


def convert(source: Path, out: Path, options: Options) -> Report:
    """Writes the map file."""
    if out.exists():
        raise LogError(out, "it exists", "choose another --out, or remove it")
    osm = _Osm(require(source, "the map"), options.origin)
    builder = MapBuilder(np.zeros(3))
    left_out: Counter[str] = Counter()
    ends: dict[tuple[str, str], list[str]] = {}
    lanes: dict[str, tuple[list[str], list[str]]] = {}
    with Progress(f"lanelet2 {source.name}", len(osm.relations)) as progress:
        for number, (tags, members) in osm.relations.items():
            kind, subtype = tags.get("type", ""), tags.get("subtype", "")
            if kind == "lanelet" and (subtype in _LANES or subtype == "crosswalk"):
                lanes[number] = osm.edges(number, members)
                left_out["second directions of lanelets"] += tags.get("one_way") == "no"
            elif kind == "multipolygon" and _AREAS.get(subtype):
                outline = [name for role, way in members if role == "outer" for name in osm.way(way, number)]
                builder.area(str(_AREAS[subtype]), osm.points(outline), f"{source}, relation {number}")
            else:
                left_out[f"relations {kind} {subtype}".strip()] += 1
            progress.step()
    for number, (left, right) in lanes.items():
        ends.setdefault((left[0], right[0]), []).append(number)
    for number, edges in lanes.items():
        _add(builder, osm, number, edges, ends)
    found = builder.file()
    if found is None:
        raise LogError(source, "no lanelet of a known subtype, and no area", f"use {', '.join(_LANES)}")
    part = out.with_name(out.name + ".partial")
    part.write_text(json.dumps(found, separators=(",", ":")) + "\n", encoding="utf-8")
    os.replace(part, out)
    sentences = [f"{what}: {count} (no field for them)" for what, count in sorted(left_out.items()) if count]
    return Report(out, {"lanes": len(found["lanes"]), "areas": len(found["areas"])}, [], sentences)


def _add(builder: MapBuilder, osm: _Osm, number: str, edges: Any, ends: dict[tuple[str, str], list[str]]) -> None:
    """Adds a lanelet as a lane, or as a crosswalk. The next lanes begin with the nodes where it ends."""
    left, right = edges
    tags = osm.relations[number][0]
    place = f"{osm.path}, relation {number}"
    if tags.get("subtype") == "crosswalk":
        return builder.area("crosswalk", [*osm.points(left), *osm.points(right)[::-1]], place)
    builder.lane(
        number,
        osm.points(left),
        osm.points(right),
        ends.get((left[-1], right[-1]), []),
        kind=_LANES[tags["subtype"]],
        is_intersection="turn_direction" in tags,
        limit_mps=_speed(tags.get("speed_limit"), place),
        place=place,
    )


def _speed(text: str | None, place: str) -> float | None:
    """A speed limit in m/s: km/h if it has no unit."""
    if text is None:
        return None
    units = {"km/h": 1 / 3.6, "kmh": 1 / 3.6, "mph": 0.44704, "m/s": 1.0, "": 1 / 3.6}
    number = text.strip().rstrip("kmhps/ ")
    try:
        return float(number) * units[text.strip()[len(number) :].strip()]
    except (ValueError, KeyError):
        raise LogError(place, f"speed_limit is {text!r}", "write a number with km/h, mph or m/s") from None


class _Osm:
    """The nodes, ways and relations of a file. A map is small: all of it is in memory."""

    def __init__(self, path: Path, origin: tuple[float, float, float] | None) -> None:
        self.path = path
        self.nodes: dict[str, Matrix] = {}
        self.ways: dict[str, list[str]] = {}
        self.relations: dict[str, tuple[dict[str, str], list[tuple[str, str]]]] = {}
        self._axes = None if origin is None else tangent_plane(*origin)
        try:
            for _, item in ElementTree.iterparse(path):
                self._take(item)
        except ElementTree.ParseError as error:
            raise LogError(path, f"not XML, or cut off: {error}", "export the map again") from None
        except (TypeError, ValueError, KeyError) as error:
            raise LogError(path, f"a node, way or relation lacks a number: {error}", "export the map again") from None

    def _take(self, item: ElementTree.Element) -> None:
        if item.attrib.get("action") == "delete":
            return  # JOSM keeps what was deleted.
        if item.tag == "node":
            self.nodes[item.attrib["id"]] = self._position(item)
        elif item.tag == "way":
            self.ways[item.attrib["id"]] = [one.attrib["ref"] for one in item.iter("nd")]
        elif item.tag == "relation":
            members = [(one.attrib.get("role", ""), one.attrib["ref"]) for one in item.iter("member")]
            self.relations[item.attrib["id"]] = (_tags(item), members)
        if item.tag in ("node", "way", "relation"):
            item.clear()

    def _position(self, item: ElementTree.Element) -> Matrix:
        tags = _tags(item)
        height = float(tags.get("ele", 0.0))
        if "local_x" in tags:
            return np.array([float(tags["local_x"]), float(tags["local_y"]), height])
        if self._axes is None:
            problem = "its nodes have latitude and longitude, and no local_x and local_y"
            raise LogError(self.path, problem, "give the twin's origin with --origin LATITUDE,LONGITUDE[,ALTITUDE]")
        middle, axes = self._axes
        return np.asarray(axes @ (earth_centred(float(item.attrib["lat"]), float(item.attrib["lon"]), height) - middle))

    def way(self, number: str, relation: str) -> list[str]:
        """The nodes of a way."""
        if number not in self.ways:
            raise LogError(f"{self.path}, relation {relation}", f"there is no way {number}", "export the map again")
        return self.ways[number]

    def points(self, names: list[str]) -> list[Matrix]:
        """Positions of nodes."""
        for name in names:
            if name not in self.nodes:
                raise LogError(self.path, f"there is no node {name}", "export the map again")
        return [self.nodes[name] for name in names]

    def edges(self, number: str, members: list[tuple[str, str]]) -> tuple[list[str], list[str]]:
        """The nodes of the left and the right edge of a lanelet, in driving direction: right is right of left."""
        found = {role: self.way(way, number) for role, way in members if role in ("left", "right")}
        if len(found) != 2 or min(len(nodes) for nodes in found.values()) < 2:
            place = f"{self.path}, relation {number}"
            raise LogError(place, "a lanelet without a left and a right line of two points", "repair the map")
        left, right = found["left"], found["right"]
        a, b = (np.array(self.points(nodes))[:, :2] for nodes in (left, right))
        # As Lanelet2 does: first the lines get one direction, then the right line is on the right.
        if np.linalg.norm(a[0] - b[0]) + np.linalg.norm(a[-1] - b[-1]) > (
            np.linalg.norm(a[0] - b[-1]) + np.linalg.norm(a[-1] - b[0])
        ):
            right, b = right[::-1], b[::-1]
        ahead, across = (a[-1] + b[-1]) - (a[0] + b[0]), (b[0] + b[-1]) - (a[0] + a[-1])
        if ahead[0] * across[1] - ahead[1] * across[0] > 0:
            left, right = left[::-1], right[::-1]
        return left, right


def _tags(item: ElementTree.Element) -> dict[str, str]:
    return {one.attrib["k"]: one.attrib["v"] for one in item.iter("tag")}
