"""WOMD records for the tests of its readers: a street in both encodings, framing, and a walk through messages without protobuf."""

import struct

import google_crc32c
import numpy as np

from scenefactory_jax.data.formats import reader_selection, womd_schema
from support.scene_documents import FORMATS

JUMP_M = FORMATS["womd"]["jump_m"]
read = reader_selection.make({"womd": FORMATS["womd"]})["womd"]

STEPS, CURRENT = 12, 3
TIMES_MICROS = 100_000 * np.arange(STEPS) + np.arange(STEPS) % 3  # a clock with jitter
LANE = np.stack([0.5 * np.arange(41) - 10.0, np.full(41, 2.0), np.full(41, 30.0)], axis=1)
EDGE = np.stack([0.5 * np.arange(41) - 10.0, np.full(41, 6.0), np.full(41, 30.0)], axis=1)
CROSSWALK = np.array([[1.0, 1, 30], [1.5, 1, 30], [1.5, 5, 30], [1.0, 5, 30]])  # a side longer than any `jump_m`
SIGN = np.array([[9.0, 4.5, 31.0]])
ROADS = ((4, 2, LANE), (7, 15, EDGE), (9, 18, CROSSWALK), (12, 17, SIGN))  # id, map element, points
SIZES = ((4.5, 2.0, 1.5), (0.75, 0.5, 1.75))
GREEN = 6


def masked(data: bytes) -> int:
    value = google_crc32c.value(data)
    return (((value >> 15) | (value << 17)) + 0xA282EAD8) % 2**32


def framed(*records: bytes) -> bytes:
    heads = [struct.pack("<Q", len(data)) for data in records]
    parts = [
        head + struct.pack("<I", masked(head)) + data + struct.pack("<I", masked(data)) for head, data in zip(heads, records, strict=True)
    ]
    return b"".join(parts)


def positions(track):
    """Two objects: a car that drives along the lane, and a pedestrian who is first seen after the current step."""
    x = -8.0 + 0.75 * np.arange(STEPS) if track == 0 else np.full(STEPS, 3.0)
    return np.stack([x, np.full(STEPS, 2.0 + track), np.full(STEPS, 30.5)], axis=1)


def observed(track):
    return np.arange(STEPS) >= (0 if track == 0 else CURRENT + 2)


def scenario():
    """The street as a Scenario message."""
    message = womd_schema.Scenario(scenario_id=b"street", current_time_index=CURRENT, sdc_track_index=0, objects_of_interest=[7])
    message.timestamps_seconds.extend(TIMES_MICROS / 1e6)
    for index in range(2):
        track = message.tracks.add(id=7 + index, object_type=1 + index)
        for (x, y, z), valid in zip(positions(index), observed(index), strict=True):
            length, width, height = SIZES[index]
            box = dict(length=length, width=width, height=height, heading=0.25, velocity_x=7.5, velocity_y=-0.5)
            track.states.add(center_x=x, center_y=y, center_z=z, valid=valid, **box)
    message.tracks_to_predict.add(track_index=1, difficulty=2)
    for step in range(STEPS):
        moment = message.dynamic_map_states.add()
        if step >= 5:
            moment.lane_states.add(lane=4, state=GREEN if step >= 8 else 4, stop_point=dict(x=1.0, y=2.0, z=30.0))
    for (identity, _, points), sort in zip(ROADS, ("lane", "road_edge", "crosswalk", "stop_sign"), strict=True):
        feature = getattr(message.map_features.add(id=identity), sort)
        if sort == "stop_sign":
            feature.lane.append(4)
            feature.position.x, feature.position.y, feature.position.z = SIGN[0]
            continue
        for x, y, z in points:
            (feature.polygon if sort == "crosswalk" else feature.polyline).add(x=x, y=y, z=z)
    lane, edge = message.map_features[0].lane, message.map_features[1].road_edge
    lane.type, lane.speed_limit_mph, edge.type = 2, 25.0, 1
    lane.entry_lanes.append(1)
    lane.exit_lanes.extend([2, 3])
    for neighbour in (5, 6, 5):
        lane.left_neighbors.add(feature_id=neighbour)
    return message


def features(*, rows=4, lag=0):
    """The street as a tf.Example's features, key -> numbers; `rows` of objects, the rest padding; lights that lag by so many steps."""
    found = {"scenario/id": b"street", "state/id": np.full(rows, -1.0), "state/type": np.full(rows, -1.0)}
    names = ("x", "y", "z", "bbox_yaw", "velocity_x", "velocity_y", "length", "width", "height")
    table = {name: np.full((rows, STEPS), -1.0) for name in names}
    valid, stamps = np.zeros((rows, STEPS), int), np.full((rows, STEPS), -1)
    for row, index in ((0, 0), (2, 1)):  # a padding row between them
        found["state/id"][row], found["state/type"][row] = 7 + index, 1 + index
        mask = observed(index)
        values = (*positions(index).T, 0.25, 7.5, -0.5, *SIZES[index])
        for column, value in zip(table.values(), values, strict=True):
            column[row] = np.where(mask, value, -1.0)
        valid[row], stamps[row] = mask, np.where(mask, TIMES_MICROS, -1)
    for name, row in (("is_sdc", 0), ("objects_of_interest", 0), ("tracks_to_predict", 2)):
        found[f"state/{name}"] = (np.arange(rows) == row).astype(int)
    found["state/difficulty_level"] = 2 * found["state/tracks_to_predict"]
    slots = np.full((STEPS, 3), -1)
    step = np.arange(STEPS) + lag  # what the lights' rows show
    lit = np.stack([step < 0, (step >= 5) & (step < STEPS), step < 0], axis=1)
    clock = np.where((step >= 0) & (step < STEPS), TIMES_MICROS[np.clip(step, 0, STEPS - 1)], -1)
    for period, part in (("past", slice(0, CURRENT)), ("current", slice(CURRENT, CURRENT + 1)), ("future", slice(CURRENT + 1, STEPS))):
        for name, column in (table | {"valid": valid, "timestamp_micros": stamps}).items():
            found[f"state/{period}/{name}"] = column[:, part].ravel()
        states = np.where(step >= 8, GREEN, 4)[:, None]
        lights = {"id": np.where(lit, 4, slots), "state": np.where(lit, states, slots), "valid": lit.astype(int)}
        lights |= {axis: np.where(lit, value, -1.0) for axis, value in zip("xyz", (1.0, 2.0, 30.0), strict=True)}
        for name, column in (lights | {"timestamp_micros": clock}).items():
            found[f"traffic_light_state/{period}/{name}"] = column[part].ravel()
    blank = 5
    for name, column in (("id", 0), ("type", 1)):
        samples = [np.full(len(road[2]), road[column]) for road in ROADS]
        found[f"roadgraph_samples/{name}"] = np.concatenate([*samples, np.full(blank, -1)])
    xyz = np.concatenate([*(road[2] for road in ROADS), np.full((blank, 3), -1.0)])
    found["roadgraph_samples/xyz"] = xyz.ravel()
    found["roadgraph_samples/valid"] = (np.arange(len(xyz)) < len(xyz) - blank).astype(int)
    return found


def example(found):
    """Features as a tf.Example message."""
    message = womd_schema.Example()
    for key, value in found.items():
        entry = message.features.feature.add(key=key.encode())
        if isinstance(value, bytes):
            entry.value.bytes_list.value.append(value)
        elif np.asarray(value).dtype.kind == "f":
            entry.value.float_list.value.extend(value)
        else:
            entry.value.int64_list.value.extend(np.asarray(value).tolist())
    return message


def saved(folder, content, name="scenes"):
    path = folder / name
    path.write_bytes(content)
    return path


def scenes(folder, *messages):
    """What the reader makes of records of these messages."""
    content = framed(*(message.SerializeToString() for message in messages))
    return list(read(saved(folder, content)))


def varints(data):
    found, value, shift = [], 0, 0
    for byte in data:
        value, shift = value | (byte & 127) << shift, shift + 7
        if byte < 128:
            found.append(value - 2**64 if value >= 2**63 else value)
            value = shift = 0
    return found


def walk(data):
    """[(field, value)] of a message: integers, bytes, or floats by their width (protobuf.dev/programming-guides/encoding)."""
    place, found = 0, []

    def varint():
        nonlocal place
        start = place
        while data[place] > 127:
            place += 1
        place += 1
        return varints(data[start:place])[0]

    while place < len(data):
        field, wire = divmod(varint(), 8)
        size = {0: 0, 1: 8, 5: 4}[wire] if wire != 2 else varint()
        raw = varint() if wire == 0 else data[place : place + size]
        place += size
        found.append((field, raw if wire in (0, 2) else struct.unpack("<d" if wire == 1 else "<f", raw)[0]))
    return found
