"""Names and classes of a log."""

from __future__ import annotations

import re

__all__ = ["CLASSES", "class_of", "name_of"]


def name_of(text: str) -> str:
    """A name of 1 to 64 of a-z 0-9 . _ - that does not begin with a dot: other characters become `_`."""
    name = re.sub(r"[^a-z0-9._-]+", "_", text.lower()).strip("_").lstrip(".")
    return name[:64] or "unnamed"


CLASSES: dict[str, tuple[str, ...]] = {
    "vehicle": (
        "car", "van", "truck", "bus", "motorcycle", "vehicle", "tram", "trailer", "construction", "emergency", "bendy",
        "regular_vehicle", "large_vehicle", "box_truck", "truck_cab", "vehicular_trailer", "school_bus",
        "articulated_bus", "motorcyclist", "railed_vehicle", "message_board_trailer",
        "traffic_light_trailer", "type_vehicle", "pickup", "medium_sized_truck", "semi_truck", "towed_object",
        "other_vehicle", "train", "caravan", "automobile", "heavy_truck", "train_or_tram_car", "trolley_bus",
        "other_large_vehicle", "rider_motorcycle", "moped",
        "pickup_truck", "emergency_vehicle", "motorized_scooter", "trolley", "subway",
    ),
    "pedestrian": (
        "pedestrian", "person", "person_sitting", "human", "adult", "child", "wheelchair", "stroller",
        "personal_mobility", "police_officer", "construction_worker", "official_signaler", "type_pedestrian",
        "wheeled_rider", "wheelchair_user", "personaltransporter",
        "pedestrian_with_object", "personal_mobility_device",
    ),
    "bicycle": ("bicycle", "cyclist", "bicyclist", "type_cyclist", "rider", "bike", "pedalcycle"),
    "object": (
        "object", "barrier", "debris", "traffic_cone", "trafficcone", "pushable_pullable", "bicycle_rack", "animal",
        "bollard", "construction_cone", "construction_barrel", "stop_sign", "sign", "dog", "generic_object",
        "czone_sign", "misc", "wheeled_device", "pylon", "traffic_sign", "cone", "type_sign", "rolling_container",
        "construction_sign", "road_barrier", "temporary_construction_barrier", "tools", "trash_bin", "box", "pole",
        "traffic_light", "lamp", "street_light", "vending_machine", "small_pole", "big_pole",
        "mobile_pedestrian_crossing_sign", "protruding_object",
        "poleobject", "trafficbeacon", "trafficsign", "trafficsignal", "trafficguide", "dynamicbarrier",
        "cones", "signs", "construction_signs", "road_barriers", "temporary_construction_barriers", "pylons",
        "rolling_containers", "animals",
    ),
}  # fmt: skip
"""Our classes of actors, and the names of each in data sets: lower case, `_` for all but letters and digits."""

_OF_NAME = {name: ours for ours, names in CLASSES.items() for name in names}


def class_of(label: str) -> str | None:
    """Our class of a label of a data set, such as `vehicle.bus.bendy` or `REGULAR_VEHICLE`; None if it is unknown.

    A label of several parts has the class of its last known part: `vehicle.bicycle` is a bicycle.
    """
    parts = [re.sub(r"[^a-z0-9]+", "_", part.lower()).strip("_") for part in re.split(r"[./]| - ", label)]
    known = [_OF_NAME[part] for part in parts if part in _OF_NAME]
    return known[-1] if known else None
