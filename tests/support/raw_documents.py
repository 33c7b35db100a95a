"""Small logs of nuPlan and nuScenes by their public schemas: a road along x that leads through a junction, and cars on it.

nuPlan has the positions in UTM, around ORIGIN, and its map in degrees; nuScenes has them as they are.
"""

import json
import math
import sqlite3
import struct

import numpy as np
import shapely
from scipy.optimize import least_squares

from scenefactory_jax.data.formats import projection

ZONE, EPSG = 19, 32619  # Boston
ORIGIN = np.array([330_000.0, 4_690_000.0])  # nuPlan's
SPEED = 8.0
LANES = {  # key: (first x, last x, y, width) of lanes along x; towards the smaller x if the last one is smaller
    11: (0.0, 60.0, -2.0, 4.0), 12: (0.0, 60.0, -6.0, 4.0), 13: (60.0, 0.0, 2.0, 4.0),
    14: (80.0, 140.0, -2.0, 4.0), 15: (80.0, 140.0, -6.0, 4.0),
}  # fmt: skip
CONNECTORS = {21: (11, 14), 22: (12, 15)}  # from, to
ISLAND = [(20, 5), (30, 5), (30, 9), (20, 9)]  # a hole of 40 m2 in a car park
AREAS = {
    "road": shapely.box(0, -8, 60, 4), "junction": shapely.box(60, -8, 80, 4), "beyond": shapely.box(80, -8, 140, 0),
    "park": shapely.Polygon([(10, 4), (40, 4), (40, 12), (10, 12)], [ISLAND]),
}  # fmt: skip
CROSSWALK, STOP = shapely.box(62, -8, 65, 4), shapely.box(57, -8, 59, 0)


def find_centre(key):
    """The centre line of a lane or a connector."""
    if key in CONNECTORS:
        before, after = CONNECTORS[key]
        return np.array([find_centre(before)[-1], find_centre(after)[0]])
    first, last, y, _ = LANES[key]
    return np.array([[first, y], [last, y]])


def find_outline(key):
    first, last, y, width = LANES[key]
    return shapely.box(min(first, last), y - width / 2, max(first, last), y + width / 2)


def to_degrees(points):
    """Longitude and latitude of positions in metres from ORIGIN, by inverting the projection."""
    found = []
    for point in np.asarray(points, float) + ORIGIN:
        scale = np.array([np.cos(np.deg2rad(42.3)), 1.0]) * 111_000.0
        apart = lambda d, point=point: (projection.project_utm(d[None], zone=ZONE, south=False)[0] - point) / 1000  # noqa: E731
        found.append(least_squares(apart, [-71.06, 42.35], xtol=1e-15, ftol=1e-15, gtol=1e-15, x_scale=1 / scale).x)
    return np.array(found)


# ---- nuPlan


def to_blob(shape, *, envelope=True, reference=4326, project=True):
    """A shape as GeoPackages have it: header, bounds, well-known binary."""
    shape = shapely.transform(shape, to_degrees) if project else shape
    low_x, low_y, high_x, high_y = shape.bounds
    bounds = struct.pack("<4d", low_x, high_x, low_y, high_y) if envelope else b""
    return b"GP" + bytes([0, 1 | (1 << 1) * envelope]) + struct.pack("<i", reference) + bounds + shapely.to_wkb(shape, byte_order=1)


LAYERS = {  # of the columns of the public maps those that differ in kind: keys, references, texts of keys, numbers, flags
    "baseline_paths": "geom LINESTRING, path_type_fid INTEGER, creator_id TEXT(256), lane_fid INTEGER, lane_connector_fid INTEGER, "
    "dubins_node_fids TEXT(256)",
    "lanes_polygons": "geom POLYGON, lane_group_fid INTEGER, lane_fid INTEGER, lane_index MEDIUMINT, creator_id TEXT(256), name TEXT(256), "
    "road_type_fid INTEGER, lane_type_fid INTEGER, width MEDIUMINT, left_offset REAL, right_offset REAL, min_speed REAL, max_speed REAL, "
    "stops MEDIUMINT, left_boundary_fid INTEGER, right_boundary_fid INTEGER, speed_limit_mps REAL, left_has_reflectors BOOLEAN, "
    "right_has_reflectors BOOLEAN, from_edge_fid INTEGER, to_edge_fid INTEGER",
    "lane_connectors": "geom LINESTRING, exit_lane_group_fid INTEGER, exit_lane_fid INTEGER, entry_lane_group_fid INTEGER, "
    "lane_group_connector_fid INTEGER, entry_lane_fid INTEGER, intersection_fid INTEGER, turn_type_fid INTEGER, bulb_fids TEXT(256), "
    "traffic_light_stop_line_fids TEXT(256), overlap MEDIUMINT, creator_id TEXT(256), reflector_side_fid INTEGER, "
    "left_has_reflectors BOOLEAN, right_has_reflectors BOOLEAN, speed_limit_mps REAL",
    "intersections": "geom POLYGON, creator_id TEXT(256), intersection_type_fid INTEGER, is_mini BOOLEAN",
    "road_segments": "geom POLYGON, lane_group_fids TEXT(256)",
    "carpark_areas": "geom MULTIPOLYGON, heading REAL, creator_id TEXT(256)",
    "boundaries": "geom LINESTRING, boundary_segment_fids TEXT(256), has_reflectors BOOLEAN, boundary_type_fid INTEGER, "
    "creator_id TEXT(256)",
    "crosswalks": "geom POLYGON, intersection_fids TEXT(256), lane_fids TEXT(256), creator_id TEXT(256), is_marked BOOLEAN",
    "stop_polygons": "geom POLYGON, stop_polygon_type_fid INTEGER, lane_group_fid INTEGER, lane_fids TEXT(256), "
    "lane_connector_fids TEXT(256), traffic_light_fids TEXT(256), crosswalk_fids TEXT(256), precedence_area_fids TEXT(256), "
    "creator_id TEXT(256)",
}


def write_nuplan_map(path):
    """The map as a GeoPackage."""
    path.parent.mkdir(parents=True)
    database = sqlite3.connect(path)
    database.executescript("""
        PRAGMA application_id = 0x47504B47;
        CREATE TABLE gpkg_spatial_ref_sys (srs_name TEXT NOT NULL, srs_id INTEGER NOT NULL PRIMARY KEY, organization TEXT NOT NULL,
            organization_coordsys_id INTEGER NOT NULL, definition TEXT NOT NULL, description TEXT);
        CREATE TABLE gpkg_contents (table_name TEXT NOT NULL PRIMARY KEY, data_type TEXT NOT NULL, identifier TEXT UNIQUE,
            description TEXT DEFAULT '', last_change DATETIME NOT NULL, min_x DOUBLE, min_y DOUBLE, max_x DOUBLE, max_y DOUBLE,
            srs_id INTEGER);
        CREATE TABLE gpkg_geometry_columns (table_name TEXT NOT NULL, column_name TEXT NOT NULL, geometry_type_name TEXT NOT NULL,
            srs_id INTEGER NOT NULL, z TINYINT NOT NULL, m TINYINT NOT NULL, PRIMARY KEY (table_name, column_name));
        CREATE TABLE meta (fid INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, key TEXT NOT NULL, value TEXT NOT NULL);
        INSERT INTO gpkg_spatial_ref_sys VALUES ('WGS 84 geodetic', 4326, 'EPSG', 4326, 'GEOGCS[...]', NULL);
        INSERT INTO meta (key, value) VALUES ('geographicCoordSystem', 'epsg:4326');
    """)
    database.execute("INSERT INTO meta (key, value) VALUES ('projectedCoordSystem', ?)", (f"epsg:{EPSG}",))

    def add(layer, fid, shape, **columns):
        names = ", ".join(["fid", "geom", *columns])
        blob = to_blob(shape, envelope=layer != "boundaries") if shape is not None else None
        database.execute(f"INSERT INTO {layer} ({names}) VALUES ({', '.join('?' * (2 + len(columns)))})", (fid, blob, *columns.values()))

    for layer, columns in LAYERS.items():
        database.execute(f"CREATE TABLE {layer} (fid INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, {columns})")
        contents = "INSERT INTO gpkg_contents (table_name, data_type, last_change, srs_id) VALUES (?, 'features', '', 4326)"
        database.execute(contents, (layer,))
        kind = columns.split()[1].strip(",")
        database.execute("INSERT INTO gpkg_geometry_columns VALUES (?, 'geom', ?, 4326, 0, 0)", (layer, kind))
    group = {11: (1, 0, 0, 13.41), 12: (1, 1, 1, None), 13: (2, 0, 0, 13.41), 14: (3, 0, 0, 13.41), 15: (3, 1, 0, 13.41)}
    for place, key in enumerate((*LANES, *CONNECTORS), start=1):
        column = "lane_fid" if key in LANES else "lane_connector_fid"
        add("baseline_paths", place, shapely.LineString(find_centre(key)), **{column: key})
    for key, (number, index, kind, limit) in group.items():
        names = {"lane_group_fid": number, "lane_fid": key, "lane_index": index, "lane_type_fid": kind, "speed_limit_mps": limit}
        add("lanes_polygons", key, find_outline(key), **names)
    for key, (before, after) in CONNECTORS.items():
        names = {"exit_lane_fid": before, "entry_lane_fid": after, "intersection_fid": 5, "speed_limit_mps": 8.0}
        add("lane_connectors", key, shapely.LineString(find_centre(key)), **names, traffic_light_stop_line_fids="71")
    add("intersections", 5, AREAS["junction"], intersection_type_fid=1, is_mini=0)
    add("road_segments", 1, AREAS["road"])
    add("road_segments", 2, AREAS["beyond"])
    add("road_segments", 3, None)
    add("carpark_areas", 1, shapely.MultiPolygon([AREAS["park"]]))
    for fid, (y, kind) in enumerate(((-4.0, 0), (0.0, 2), (-8.0, 3)), start=31):
        add("boundaries", fid, shapely.LineString([(0, y), (60, y)]), boundary_type_fid=kind, has_reflectors=0)
    add("crosswalks", 41, CROSSWALK, is_marked=1)
    add("stop_polygons", 71, STOP, stop_polygon_type_fid=2, lane_connector_fids="21,22")
    add("stop_polygons", 72, STOP, stop_polygon_type_fid=1, lane_fids="11, 12", lane_connector_fids="21,22")
    database.commit()
    database.close()


def token(number):
    return int(number).to_bytes(8, "big")


TABLES = """
    CREATE TABLE log (token BLOB NOT NULL, vehicle_name VARCHAR(64), date VARCHAR(64), timestamp INTEGER, logfile VARCHAR(64),
        location VARCHAR(64), map_version VARCHAR(64), PRIMARY KEY (token));
    CREATE TABLE ego_pose (token BLOB NOT NULL, timestamp INTEGER, x FLOAT, y FLOAT, z FLOAT, qw FLOAT, qx FLOAT, qy FLOAT, qz FLOAT,
        vx FLOAT, vy FLOAT, vz FLOAT, acceleration_x FLOAT, acceleration_y FLOAT, acceleration_z FLOAT, angular_rate_x FLOAT,
        angular_rate_y FLOAT, angular_rate_z FLOAT, epsg INTEGER, log_token BLOB NOT NULL, PRIMARY KEY (token));
    CREATE TABLE scene (token BLOB NOT NULL, log_token BLOB NOT NULL, name TEXT, goal_ego_pose_token BLOB, roadblock_ids TEXT,
        PRIMARY KEY (token));
    CREATE TABLE lidar_pc (token BLOB NOT NULL, next_token BLOB, prev_token BLOB, ego_pose_token BLOB NOT NULL, lidar_token BLOB NOT NULL,
        scene_token BLOB, filename VARCHAR(128), timestamp INTEGER, PRIMARY KEY (token));
    CREATE TABLE category (token BLOB NOT NULL, name VARCHAR(64), description TEXT, PRIMARY KEY (token));
    CREATE TABLE track (token BLOB NOT NULL, category_token BLOB NOT NULL, width FLOAT, length FLOAT, height FLOAT, PRIMARY KEY (token));
    CREATE TABLE lidar_box (token BLOB NOT NULL, lidar_pc_token BLOB NOT NULL, track_token BLOB NOT NULL, next_token BLOB, prev_token BLOB,
        x FLOAT, y FLOAT, z FLOAT, width FLOAT, length FLOAT, height FLOAT, vx FLOAT, vy FLOAT, vz FLOAT, yaw FLOAT, confidence FLOAT,
        PRIMARY KEY (token));
    CREATE TABLE scenario_tag (token BLOB NOT NULL, lidar_pc_token BLOB NOT NULL, type TEXT, agent_track_token BLOB, PRIMARY KEY (token));
    CREATE TABLE traffic_light_status (token BLOB NOT NULL, lidar_pc_token BLOB NOT NULL, lane_connector_id INTEGER, status VARCHAR(8),
        PRIMARY KEY (token));
"""
FRAMES, FRAME_US = 60, 50_000
START_US = 1_620_857_890_400_000


def write_nuplan_log(path, frames=FRAMES, location="boston", version="us-ma-boston"):
    """A log: the recording car on lane 11; a car before it, a parked one without velocities, a person at some frames, and a cone."""
    path.parent.mkdir(parents=True, exist_ok=True)
    database = sqlite3.connect(path)
    database.executescript(TABLES)

    def add(table, *values):
        database.execute(f"INSERT INTO {table} VALUES ({', '.join('?' * len(values))})", values)

    add("log", token(1), "veh-47", "2021-05-12", START_US, path.stem, location, version)
    for number, name in enumerate(("vehicle", "bicycle", "pedestrian", "traffic_cone"), start=11):
        add("category", token(number), name, "")
    for number, kind, size in ((101, 11, (2.0, 4.6, 1.5)), (102, 11, (1.8, 4.2, 1.4)), (103, 13, (0.7, 0.8, 1.7)), (104, 14, (None,) * 3)):
        add("track", token(number), token(kind), *size)
    for scene in (201, 202):
        add("scene", token(scene), token(1), f"scene-{scene}", None, "1 2")
    for frame in range(frames):
        time, pc = START_US + FRAME_US * frame, token(1000 + frame)
        x, y = np.add(ORIGIN, (10.0 + SPEED * FRAME_US * 1e-6 * frame, -2.0)).tolist()
        pose = (x, y, 3.0, 1.0, 0.0, 0.0, 0.0, SPEED, 0.0, 0.0, *(0.0,) * 6, EPSG, token(1))
        add("ego_pose", token(5000 + frame), time + 700, *pose)
        add("lidar_pc", pc, None, None, token(5000 + frame), token(9), token(201 + (frame >= frames // 2)), "", time)
        boxes = [(101, (20.0 + 4.0 * FRAME_US * 1e-6 * frame, -6.0), (4.0, 0.0), 0.0, (2.0, 4.6, 1.5))]
        boxes += [(102, (30.0, 2.0), (None, None), math.pi, (None,) * 3), (104, (35.0, -7.5), (0.0, 0.0), 0.0, (None,) * 3)]
        boxes += [(103, (63.0, 0.0), (0.0, -1.0), -math.pi / 2, (0.7, 0.8, 1.7))] if 20 <= frame < 30 else []
        for place, (number, where, velocity, turn, size) in enumerate(boxes):
            spot = (*(ORIGIN + where), 1.0)
            add("lidar_box", token(10_000 + 10 * frame + place), pc, token(number), None, None, *spot, *size, *velocity, None, turn, 1.0)
        if frame >= 4:
            add("traffic_light_status", token(30_000 + 2 * frame), pc, 21, "red" if frame < 40 else "green")
            add("traffic_light_status", token(30_001 + 2 * frame), pc, 999, "red")
    for number, frame in enumerate((25, 26, 27)):
        add("scenario_tag", token(40_000 + number), token(1000 + frame), "near_pedestrian_on_crosswalk", None)
    database.commit()
    database.close()


# ---- nuScenes


def write_nuscenes(folder, *, key_frames=7, city="boston-seaport"):
    """The tables of a scene, with key frames every 0.5 s, and the map beside: `folder/v1.0-mini`, `folder/maps/expansion`."""
    start = 1_533_151_603_500_000
    rotate = lambda yaw: [math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)]  # noqa: E731
    samples = [{"token": f"s{n}", "timestamp": start + 500_000 * n, "prev": f"s{n - 1}" if n else "",
                "next": f"s{n + 1}" if n + 1 < key_frames else "", "scene_token": "scene"} for n in range(key_frames)]  # fmt: skip
    data, poses, notes = [], [], []
    for sweep in range(10 * (key_frames - 1) + 1):
        time, sample = start + 50_000 * sweep, -(-sweep // 10)
        for channel in ("LIDAR_TOP", "CAM_FRONT"):
            name = f"{channel}{sweep}"
            data.append({"token": name, "sample_token": f"s{sample}", "ego_pose_token": name, "calibrated_sensor_token": f"c{channel}",
                         "timestamp": time, "fileformat": "pcd", "is_key_frame": sweep % 10 == 0, "height": 0, "width": 0,
                         "filename": "", "prev": "", "next": ""})  # fmt: skip
            lateral = 0.0 if channel == "LIDAR_TOP" else 50.0  # a pose that must not be taken
            place = [10 + SPEED * sweep / 20, -2 + lateral, 0.0]
            poses.append({"token": name, "timestamp": time, "rotation": rotate(0.0), "translation": place})
    things = {"car": ("vehicle.car", range(key_frames)), "walker": ("human.pedestrian.adult", (2, 3, 5))}
    things["cycle"] = ("vehicle.bicycle", range(3))
    for name, (_, frames) in things.items():
        for n in frames:
            spot = {"car": [20 + 2.0 * n, -6.0, 0.8], "walker": [63.0, n - 3.0, 0.9], "cycle": [40.0, -7.5, 0.6]}[name]
            notes.append({"token": f"{name}{n}", "sample_token": f"s{n}", "instance_token": name, "visibility_token": "4",
                          "attribute_tokens": ["stands"] if name == "cycle" else [], "translation": spot, "size": [1.9, 4.5, 1.6],
                          "rotation": rotate({"car": math.pi - 0.1 if n % 2 else -math.pi + 0.1}.get(name, math.pi / 2)),
                          "prev": "", "next": "", "num_lidar_pts": 9, "num_radar_pts": 0})  # fmt: skip
    tables = {
        "scene": [{"token": "scene", "log_token": "log", "nbr_samples": key_frames, "first_sample_token": "s0",
                   "last_sample_token": samples[-1]["token"], "name": "scene-0061", "description": ""}],
        "sample": samples, "sample_data": data, "ego_pose": poses, "sample_annotation": notes,
        "calibrated_sensor": [{"token": f"c{c}", "sensor_token": c, "translation": [0, 0, 0], "rotation": [1, 0, 0, 0],
                               "camera_intrinsic": []} for c in ("LIDAR_TOP", "CAM_FRONT")],
        "sensor": [{"token": "LIDAR_TOP", "channel": "LIDAR_TOP", "modality": "lidar"},
                   {"token": "CAM_FRONT", "channel": "CAM_FRONT", "modality": "camera"}],
        "instance": [{"token": name, "category_token": kind, "nbr_annotations": len(frames), "first_annotation_token": "",
                      "last_annotation_token": ""} for name, (kind, frames) in things.items()],
        "category": [{"token": kind, "name": kind, "description": "", "index": 1} for kind, _ in things.values()],
        "attribute": [{"token": "stands", "name": "cycle.without_rider", "description": ""}],
        "log": [{"token": "log", "logfile": "n008", "vehicle": "n008", "date_captured": "2018-08-01", "location": city}],
        "map": [{"category": "semantic_prior", "token": "m", "filename": "maps/m.png", "log_tokens": ["log"]}],
        "visibility": [{"token": "4", "level": "v80-100", "description": ""}],
    }  # fmt: skip
    (folder / "v1.0-mini").mkdir(parents=True)
    (folder / "maps" / "expansion").mkdir(parents=True)
    for name, rows in tables.items():
        (folder / "v1.0-mini" / f"{name}.json").write_text(json.dumps(rows, indent=0))
    (folder / "maps" / "expansion" / f"{city}.json").write_text(json.dumps(nuscenes_map()))
    return folder / "v1.0-mini" / "scene.json"


def nuscenes_map():
    """The map; the way from lane 12 to 15 bends aside and back, by two arcs of 8 m."""
    whole = {"version": "1.3", "canvas_edge": [200.0, 200.0], "polygon": [], "line": [], "node": []}
    layers = ("drivable_area", "road_segment", "road_block", "lane", "ped_crossing", "walkway", "stop_line", "carpark_area")
    whole |= {name: [] for name in (*layers, "lane_connector", "road_divider", "lane_divider", "traffic_light")}

    def nodes(points):
        names = [f"n{len(whole['node']) + place}" for place in range(len(points))]
        whole["node"] += [{"token": name, "x": float(x), "y": float(y)} for name, (x, y) in zip(names, points, strict=True)]
        return names

    def add(layer, name, shape=None, **more):
        record = {"token": name}
        if shape is not None and shape.geom_type == "Polygon":
            outer, *inner = ([*map(tuple, ring.coords)][:-1] for ring in (shape.exterior, *shape.interiors))
            holes = [{"node_tokens": nodes(ring)} for ring in inner]
            whole["polygon"].append({"token": f"p{name}", "exterior_node_tokens": nodes(outer), "holes": holes})
            record |= {"polygon_tokens": [f"p{name}"]} if layer == "drivable_area" else {"polygon_token": f"p{name}"}
        elif shape is not None:
            names = nodes(list(shape.coords))
            whole["line"].append({"token": f"l{name}", "node_tokens": names})
            record |= {"line_token": f"l{name}"}
        whole[layer].append(record | more)

    for name in ("road", "beyond", "park", "junction"):
        add("drivable_area", name, AREAS[name])
    add("road_segment", "inside", AREAS["junction"], is_intersection=True, drivable_area_token="junction")
    paths, links = {}, {}
    for key in LANES:
        segments = {"left_lane_divider_segments": [], "right_lane_divider_segments": []}
        add("lane", f"lane{key}", find_outline(key), lane_type="CAR", from_edge_line_token="", to_edge_line_token="", **segments)
        (x0, y0), (x1, _) = find_centre(key)
        path = {"start_pose": [x0, y0, 0.0 if x1 > x0 else math.pi], "end_pose": [], "shape": "LSR", "radius": 30.0}
        paths[f"lane{key}"] = [path | {"segment_length": [0.0, abs(x1 - x0), 0.0]}]
        links[f"lane{key}"] = {"incoming": [f"way{c}" for c, (_, end) in CONNECTORS.items() if end == key],
                               "outgoing": [f"way{c}" for c, (begin, _) in CONNECTORS.items() if begin == key]}  # fmt: skip
    for key, (before, after) in CONNECTORS.items():
        add("lane_connector", f"way{key}", shapely.box(60, -8, 80, 0))
        (x0, y0), _ = find_centre(key)
        shape, lengths = ("LSL", [0.0, 20.0, 0.0]) if key == 21 else ("LRL", [0.5 * 8.0, 8.0, 0.5 * 8.0])
        paths[f"way{key}"] = [{"start_pose": [x0, y0, 0.0], "end_pose": [], "shape": shape, "radius": 8.0, "segment_length": lengths}]
        links[f"way{key}"] = {"incoming": [f"lane{before}"], "outgoing": [f"lane{after}", "far"]}
    add("ped_crossing", "zebra", CROSSWALK, road_segment_token="inside")
    cues = {"ped_crossing_tokens": [], "traffic_light_tokens": [], "road_block_token": ""}
    add("stop_line", "stop", STOP, stop_line_type="STOP_SIGN", **cues)
    add("stop_line", "light", STOP, stop_line_type="TRAFFIC_LIGHT", **cues)
    add("road_divider", "middle", shapely.LineString([(0, 0), (60, 0)]), road_segment_token=None)
    points = nodes([(0, -4), (20, -4), (40, -4), (60, -4)])
    kinds = ("DOUBLE_DASHED_WHITE", "DOUBLE_DASHED_WHITE", "NIL", "NIL")
    whole["line"].append({"token": "ldashes", "node_tokens": points})
    segments = [{"node_token": name, "segment_type": kind} for name, kind in zip(points, kinds, strict=True)]
    add("lane_divider", "dashes", lane_divider_segments=[*segments[2:], *segments[:3]], line_token="ldashes")  # as they come: in no order
    return whole | {"arcline_path_3": paths, "connectivity": links}
