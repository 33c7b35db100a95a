"""Small files of the other scene formats, made by hand: a street of two lanes with a light, and a car that drives along it."""

import io
import json
import pickle
import struct

import numpy as np
import pyarrow as pa
import pyarrow.parquet

STEPS = 12


def street(y, count=81):
    return np.stack([np.linspace(-40.0, 40.0, count), np.full(count, y), np.zeros(count)], axis=1)


def scenarionet_track(x, *, kind="VEHICLE", name="7", speed=5.0):
    steps = np.arange(STEPS)
    state = {
        "position": np.stack([x + 0.1 * speed * steps, 0.0 * steps, 0.0 * steps + 0.75], axis=1),
        "heading": np.zeros(STEPS),
        "velocity": np.tile([speed, 0.0], (STEPS, 1)),
        "valid": steps > 1,
        **{key: np.full(STEPS, size) for key, size in (("length", 4.5), ("width", 1.9), ("height", 1.5))},
    }
    return {"type": kind, "state": state, "metadata": {"track_length": STEPS, "type": kind, "object_id": name}}


def scenarionet_document():
    lane = {"type": "LANE_SURFACE_STREET", "polyline": street(0.0), "entry_lanes": [2], "exit_lanes": ["3", 99], "speed_limit_mph": 25.0}
    lane |= {"left_neighbor": [{"feature_id": "2"}, {"feature_id": "2"}], "right_neighbor": []}
    states = ["LANE_STATE_STOP", None, "TRAFFIC_LIGHT_GREEN", *["LANE_STATE_ARROW_GO"] * (STEPS - 3)]
    light = {"type": "TRAFFIC_LIGHT", "state": {"object_state": states}, "lane": 1, "stop_point": np.array([5.0, 0.0, 0.0])}
    return {
        "id": "street", "version": "MetaDrive v0.3.0.1", "length": STEPS,
        "metadata": {"ts": 0.1 * np.arange(STEPS), "dataset": "waymo", "sdc_id": "7", "current_time_index": 10, "scenario_id": "abc"}
        | {"objects_of_interest": ["ego"], "tracks_to_predict": {"7": {"track_index": 0}}},
        "tracks": {"7": scenarionet_track(0.0), "ego": scenarionet_track(-20.0, kind="CYCLIST", name="ego")},
        "dynamic_map_states": {"1": light},
        "map_features": {
            "1": lane,
            "2": {"type": "LANE_BIKE_LANE", "polyline": street(4.0), "entry_lanes": [], "exit_lanes": [], "speed_limit_mph": 0.0},
            "3": {"type": "ROAD_EDGE_BOUNDARY", "polyline": street(-4.0)},
            "boundary_0": {"type": "ROAD_LINE_SOLID_SINGLE_WHITE", "polyline": street(6.0, 11)[:, :2].tolist()},
            "walk": {"type": "ROAD_EDGE_SIDEWALK", "polygon": street(7.0)},
            "5": {"type": "STOP_SIGN", "position": np.array([9.0, -3.0, 1.0]), "lane": [1]},
            "6": {"type": "CROSSWALK", "polygon": street(0.0, 4)},
        },
    }  # fmt: skip


def metadrive_document():
    """MetaDrive's own map, as `export_scenarios` of 0.4.3 writes it: two roads of two lanes side by side, a ramp's lane, no road edge.

    Lines are called by the lane beside them and its side; the road's sides are solid white lines, as is the one that closes the ramp off.
    """
    rim = lambda y, half=1.75: np.concatenate([street(y - half, 21)[:, :2], street(y + half, 21)[::-1, :2]])  # noqa: E731
    features = {}
    for towards, places in (("('>', '>>', ", (-1.75, -5.25, -8.75)), ("('->>', '->', ", (1.75, 5.25))):
        for index, y in enumerate(places):
            turn = 1 if towards[2] == ">" else -1
            lane = {"type": "LANE_SURFACE_STREET", "polyline": street(y, 41)[::turn, :2], "polygon": rim(y), "speed_limit_kmh": 1000}
            features[f"{towards}{index})"] = lane | {"left_neighbor": [], "right_neighbor": [], "entry_lanes": [], "exit_lanes": []}
    features["('>', '>>', 1)"]["speed_limit_kmh"] = 40
    drawn = {
        "('>', '>>', 0)_0": ("ROAD_LINE_SOLID_SINGLE_YELLOW", 0.0), "('>', '>>', 1)_0": ("ROAD_LINE_BROKEN_SINGLE_WHITE", -3.5),
        "('>', '>>', 1)_1": ("ROAD_LINE_SOLID_SINGLE_WHITE", -7.0), "('>', '>>', 2)_1": ("ROAD_LINE_SOLID_SINGLE_WHITE", -10.5),
        "('->>', '->', 0)_0": ("ROAD_LINE_SOLID_SINGLE_YELLOW", 0.0), "('->>', '->', 1)_0": ("ROAD_LINE_BROKEN_SINGLE_WHITE", 3.5),
        "('->>', '->', 1)_1": ("UNKNOWN_LINE", 7.0),  # a guardrail
    }  # fmt: skip
    for key, (kind, y) in drawn.items():
        features[key] = {"type": kind, "polyline": street(y, 41)[:, :2], "speed_limit_kmh": 1000}
    features["sidewalk"] = {"type": "ROAD_EDGE_SIDEWALK", "polygon": rim(-11.5, 1.0)}  # beside the road, and no lane
    document = scenarionet_document()
    metadata = {"ts": 0.1 * np.arange(STEPS), "dataset": "metadrive", "sdc_id": "7", "coordinate": "metadrive", "scenario_id": "PGMap-3"}
    return document | {"id": "PGMap-3", "metadata": metadata, "map_features": features, "dynamic_map_states": {}}


def in_spring_2023(document):
    """The layout of April 2023: lights as arrays, sizes in columns of their own."""
    lane, stop = np.full(STEPS, 1), np.tile([5.0, 0.0, 0.0], (STEPS, 1))
    lane[1] = 0
    state = {"object_state": np.array([4, 0, 6, *[3] * (STEPS - 3)]), "lane": lane, "stop_point": stop}
    tracks = {}
    for key, track in document["tracks"].items():
        wide = {name: track["state"][name][:, None] for name in ("length", "width", "height", "heading", "valid")}
        tracks[key] = track | {"state": track["state"] | wide}
    features = document["map_features"] | {"6": {"type": "CROSS_WALK", "polyline": street(0.0, 4)}}
    light = {"type": "TRAFFIC_LIGHT", "state": state}
    return document | {"tracks": tracks, "dynamic_map_states": {"1": light}, "map_features": features}


def in_march_2023(document):
    """The layout of March 2023: no metadata, no `state` in tracks, sizes in one array, lights step by step."""
    observed = document["dynamic_map_states"]["1"]["state"]["object_state"]
    names = {"TRAFFIC_LIGHT_GREEN": "LANE_STATE_GO"}
    lights = [[{"lane": 1, "state": names.get(name, name), "stop_point": np.array([5.0, 0.0, 0.0])}] if name else [] for name in observed]
    tracks = {}
    for key, track in document["tracks"].items():
        state = track["state"]
        size = np.stack([state[name] for name in ("length", "width", "height")], axis=1)
        tracks[key] = {"type": track["type"], "size": size, **{k: state[k] for k in ("position", "velocity")}}
        tracks[key] |= {name: state[name][:, None] for name in ("heading", "valid")}
    features = {int(key) if key.isdecimal() else key: feature for key, feature in document["map_features"].items()}
    return {
        "id": "street", "version": "Mar23", "ts": document["metadata"]["ts"].tolist(), "tracks": tracks, "sdc_track_index": 7,
        "dynamic_map_states": lights, "map_features": features,
    }  # fmt: skip


def argoverse2_files(scenario="a-b"):
    """The parquet file's bytes, and the map as a document."""
    rows = [("AV", "vehicle", 2, x, 0.0) for x in (-20.0,)] + [("12", "pedestrian", 3, 5.0, 6.0)]
    table = {name: [] for name in ("observed", "track_id", "object_type", "object_category", "timestep", "position_x", "position_y")}
    for name, kind, category, x, y in rows:
        for step in range(STEPS):
            values = (step < 5, name, kind, category, step, x + step, y)
            for key, value in zip(table, values, strict=True):
                table[key].append(value)
    count = len(table["timestep"])
    table |= {"heading": [0.0] * count, "velocity_x": [10.0] * count, "velocity_y": [0.0] * count, "scenario_id": [scenario] * count}
    table |= {"start_timestamp": [0.0] * count, "end_timestamp": [1.1e9] * count, "num_timestamps": [STEPS] * count}
    table |= {"focal_track_id": ["12"] * count, "city": ["austin"] * count}
    buffer = io.BytesIO()
    pyarrow.parquet.write_table(pa.table(table), buffer)
    return buffer.getvalue(), argoverse2_map()


def point(x, y, z=20.0):
    return {"x": float(x), "y": float(y), "z": float(z)}


def segment(identity, y, way, *, left, marks=("DOUBLE_SOLID_YELLOW", "NONE")):
    """A straight lane of 60 m whose left boundary is at y = 0 on either side of the road."""
    ends = [-30.0 * way, 30.0 * way]
    borders = {f"{side}_lane_boundary": [point(x, y + 2 * out * way) for x in ends] for side, out in (("left", 1), ("right", -1))}
    links = {"predecessors": [], "successors": [7], "left_neighbor_id": left, "right_neighbor_id": None}
    kinds = {"lane_type": "VEHICLE", "is_intersection": False, "left_lane_mark_type": marks[0], "right_lane_mark_type": marks[1]}
    return {"id": identity, **borders, **links, **kinds}


def argoverse2_map():
    """A road along x of two opposite lanes, of which the west end lies where the map was cut."""
    area = [point(-30, -4), point(30, -4), point(30, 4), point(-30, 4)]
    crossing = {"id": 9, "edge1": [point(0, -4), point(0, 4)], "edge2": [point(3, -4), point(3, 4)]}
    return {
        "lane_segments": {"1": segment(1, -2, 1, left=2), "2": segment(2, 2, -1, left=1)},
        "drivable_areas": {"5": {"id": 5, "area_boundary": area}},
        "pedestrian_crossings": {"9": crossing},
    }


def pufferdrive_map():
    """Two objects and three roads."""
    content = [struct.pack("<ii", 2, 3)]
    for kind, x in ((1, 0.0), (2, -9.0)):
        steps = np.arange(STEPS)
        columns = [x + steps, 0 * steps, 0 * steps, 0 * steps + 10, 0 * steps, 0 * steps, 0 * steps]
        content += [struct.pack("<ii", kind, STEPS), np.array(columns, "<f4").tobytes(), np.ones(STEPS, "<i4").tobytes()]
        content.append(struct.pack("<6fi", 1.9, 4.5, 1.5, 11.0, 0.0, 0.0, kind == 2))
    for kind, line in ((4, street(0.0, 3)), (6, street(4.0, 2)), (7, street(0.0, 1))):
        content += [struct.pack("<ii", kind, len(line)), line.T.astype("<f4").tobytes(), struct.pack("<6fi", *[0.0] * 6, 0)]
    return b"".join(content)


def dumped(document):
    return pickle.dumps(document)


def encoded(document):
    return json.dumps(document).encode()
