"""Checking, packing and grids as plain loops over polylines and tracks: what the fast versions must equal, bit for bit.

Each function does to one polyline or track after another what `scenes.checks`, `scenes.pack` and `cells` do to all at once.
"""

import itertools
from dataclasses import replace

import numpy as np

from scenefactory_jax.core.scene_arrays import wrap_angles
from scenefactory_jax.core.types import ROAD_USERS, STOP_SIGN, Scene
from scenefactory_jax.data.packing import columns, control_columns, route_columns, route_conflicts
from scenefactory_jax.data.packing.leaving import SAME_LEVEL_M
from scenefactory_jax.data.packing.pack import CUTS, DEGENERATE_M, DROPS, TRAFFIC_DROPS, PackReport, _find_centre, overlaps
from scenefactory_jax.data.packing.validation import DUPLICATE_M, list_ids
from scenefactory_jax.roadgraph.spatial_grid import SLACK_M


def check(raw, *, track_speed_limit_m_s, car_size_m, **_):  # of scenes without a number beyond the rest
    lines = []
    roads = _repair_roads(raw.roads, lines)
    tracks, sdc = _repair_tracks(raw, tuple(float(x) for x in car_size_m), lines)
    repaired = replace(raw, roads=roads, tracks=tracks, sdc=sdc)
    _report_jumps(repaired, track_speed_limit_m_s, lines)
    return repaired, lines


def _repair_roads(roads, lines):
    """Without duplicate points, and without lines of fewer than two points, stop signs excepted."""
    kept, short, duplicates = [], 0, 0
    for line in roads:
        step = np.linalg.norm(np.diff(line.xyz[:, :2], axis=0), axis=1)
        different = np.concatenate([np.ones(min(len(line.xyz), 1), bool), step > DUPLICATE_M])
        duplicates += int((~different).sum())
        if different.sum() < (1 if line.kind == STOP_SIGN else 2):
            short += 1
            continue
        kept.append(line if different.all() else replace(line, xyz=line.xyz[different]))
    if duplicates:
        lines.append(f"duplicate points removed: {duplicates}")
    if short:
        lines.append(f"polylines of fewer than two points dropped: {short}")
    return tuple(kept)


def _repair_tracks(raw, car_size, lines):
    """Without tracks that are nowhere valid, with positive sizes, and zeros at invalid steps; the SDC's new index."""
    kept, sdc, empty, sizes, stale = [], None, 0, [], 0
    for index, track in enumerate(raw.tracks):
        if not track.valid.any():
            empty += 1
            continue
        if index == raw.sdc:
            sdc = len(kept)
        if not (np.all(np.isfinite(track.size)) and min(track.size) > 0):
            sizes.append(track.id)
            track = replace(track, size=car_size)
        hidden = ~track.valid
        if any(np.any(table[hidden] != 0) for table in (track.xyz, track.yaw, track.velocity)):
            stale += 1
            mask = track.valid[:, None]
            xyz, velocity = np.where(mask, track.xyz, 0.0), np.where(mask, track.velocity, 0.0)
            track = replace(track, xyz=xyz, yaw=np.where(track.valid, track.yaw, 0.0), velocity=velocity)
        kept.append(track)
    if empty:
        lines.append(f"tracks without a valid step dropped: {empty}")
    if sizes:
        lines.append(f"sizes that are not positive replaced by {car_size}: {len(sizes)} (ids {list_ids(sizes)})")
    if stale:
        lines.append(f"tracks with values at invalid steps zeroed there: {stale}")
    return tuple(kept), sdc


def _report_jumps(raw, limit_m_s, lines):
    """Tracks whose positions imply more than the limit between two neighbouring valid steps."""
    steps, ids = 0, []
    for track in raw.tracks:
        pairs = track.valid[1:] & track.valid[:-1]
        speed = np.linalg.norm(np.diff(track.xyz[:, :2], axis=0), axis=1) / np.diff(raw.times)
        if jumps := int((pairs & (speed > limit_m_s)).sum()):
            steps += jumps
            ids.append(track.id)
    if ids:
        lines.append(f"track jumps above {limit_m_s:g} m/s: {steps} steps (ids {list_ids(ids)})")


def pack(
    raw,
    *,
    scene_size_m,
    centre,
    gap_m,
    outline_m,
    agents,
    min_travel_m,
    car_size_m,
    start_speed,
    log_from,
    require_agents,
    traffic,
    min_traffic_size_m,
    routes,
    starts,
    conflicts,
    controls,
    elevation,
):
    assert elevation is None and routes is None and starts is None and conflicts is None  # roadgraph tests have routes
    origin, centred_on = _find_centre(raw, centre)
    half = scene_size_m / 2
    road, cut, relief = _segments(raw, origin, half, gap_m, outline_m)
    chosen, dropped = _choose(raw, origin, half, min_travel_m, agents, car_size_m)
    first = raw.current if log_from == "current" else 0
    tracks = [raw.tracks[i] for i in chosen]
    leaves = columns.with_subsets(road) | _agents(tracks, raw, origin, agents, car_size_m, start_speed)
    leaves |= _log(tracks, raw, origin, agents, first) | {"weather.film_mm": np.zeros(()), "weather.surface": np.zeros(())}
    beside, others, traffic_dropped = _others(raw, chosen, leaves, origin, half, first, traffic, min_traffic_size_m)
    stops = control_columns.pack_controls(raw, origin, half, controls)
    leaves |= beside | stops.columns | route_columns.make_no_routes(agents, len(beside["traffic_log.kind"]))
    leaves |= route_conflicts.make_no_zones(len(beside["traffic_log.kind"]))
    report = PackReport(
        name=raw.name,
        source=raw.source,
        centre=(float(origin[0]), float(origin[1]), float(origin[2])),
        centred_on=centred_on,
        steps=len(raw.times) - first,
        current=raw.current - first,
        track_ids=tuple(track.id for track in tracks),
        traffic_ids=tuple(raw.tracks[i].id for i in others),
        agents_kept=len(tracks),
        agents_dropped=dropped,
        traffic_kept=len(beside["traffic_log.kind"]),
        traffic_dropped=traffic_dropped,
        routes=None,
        controls_kept=len(stops.columns["controls.lane"]),
        controls_dropped=stops.dropped,
        signs_inferred=stops.inferred,
        segments_kept=len(road["road.kind"]),
        segments_cut=cut,
        relief_m=relief,
        metadata=dict(raw.metadata),
    )
    return columns.assemble_columns(Scene, {name: np.asarray(leaf, columns.COLUMNS[name].dtype) for name, leaf in leaves.items()}), report


def _segments(raw, origin, half, gap_m, outline_m):
    """Columns of `road` in storage order, the count of segments cut by reason, and the heights' range."""
    order = sorted((i for i, line in enumerate(raw.roads) if len(line.xyz) >= 2), key=lambda i: raw.roads[i].kind)  # stable
    rows = {name: [] for name in ("midpoint", "direction", "half_length", "arc", "kind", "polyline")}
    cut, heights = dict.fromkeys(CUTS, 0), [np.zeros(0)]
    for index in order:
        line = raw.roads[index]
        polygon = line.kind in (18, 19, 20)
        xyz = outline(line.xyz, outline_m) if polygon else line.xyz
        points = xyz[:, :2] - origin[:2]
        delta = np.diff(points, axis=0)
        length = np.linalg.norm(delta, axis=1)
        within = np.abs(points).max(axis=1) <= half
        inside = within[1:] & within[:-1]
        degenerate, gap = length <= DEGENERATE_M, (length > gap_m) & (not polygon)
        kept = inside & ~degenerate & ~gap
        for reason, mask in zip(CUTS, (~inside, inside & gap, inside & degenerate), strict=True):
            cut[reason] += int(mask.sum())
        rows["midpoint"].append(((points[1:] + points[:-1]) / 2)[kept])
        rows["direction"].append(delta[kept] / length[kept, None])
        rows["half_length"].append(length[kept] / 2)
        rows["arc"].append((np.cumsum(length) - length / 2)[kept])
        rows["kind"].append(np.full(kept.sum(), line.kind))
        rows["polyline"].append(np.full(kept.sum(), index))
        heights.append(xyz[1:][kept, 2])
    road = {f"road.{name}": np.concatenate(parts) for name, parts in rows.items()}
    road = {name: leaf.astype(columns.COLUMNS[name].dtype) for name, leaf in road.items()}
    road["road.valid"] = np.ones(len(road["road.kind"]), bool)
    height = np.concatenate(heights)
    return road, cut, float(np.ptp(height)) if len(height) else 0.0


def outline(xyz, outline_m):
    """The way around a polygon, from corner to corner in even steps."""
    corners = list(xyz)
    if len(xyz) > 2 and np.hypot(*(xyz[-1] - xyz[0])[:2]) > DEGENERATE_M:
        corners.append(xyz[0])
    points = []
    for here, there in itertools.pairwise(corners):
        steps = max(int(np.ceil(np.linalg.norm(there - here) / outline_m)), 1)
        points += [here + step / steps * (there - here) for step in range(steps)]
    return np.array([*points, corners[-1]])


def _choose(raw, origin, half, min_travel_m, slots, car_size_m):
    """Indices of the tracks that become agents, nearest to the centre first, and the others counted by reason."""
    dropped, candidates = dict.fromkeys(DROPS, 0), []
    for index, track in enumerate(raw.tracks):
        if reason := _objection(track, raw.current, origin, half, min_travel_m):
            dropped[reason] += 1
        else:
            start = track.xyz[raw.current, :2] - origin[:2]
            candidates.append((float(np.hypot(*start)), index))
    kept = []
    boxes = np.zeros((0, 4, 2))
    for _, index in sorted(candidates):
        track = raw.tracks[index]
        length, width = car_size_m or track.size[:2]
        box = corners(track.xyz[raw.current, :2] - origin[:2], track.yaw[raw.current], length, width)
        if overlaps(box, boxes).any():
            dropped["overlaps"] += 1
        elif len(kept) == slots:
            dropped["over_capacity"] += 1
        else:
            kept.append(index)
            boxes = np.concatenate([boxes, box[None]])
    return kept, dropped


def _objection(track, current, origin, half, min_travel_m):
    """Why a track is no agent; None if it may be one."""
    if track.kind != "vehicle":
        return "not_a_vehicle"
    if not track.valid[current]:
        return "absent_at_start"
    start, goal = track.xyz[current, :2] - origin[:2], track.xyz[_last(track), :2] - origin[:2]
    if np.abs(start).max() > half:
        return "start_outside_box"
    if np.abs(goal).max() > half:
        return "goal_outside_box"
    return "too_short" if np.hypot(*(goal - start)) < min_travel_m else None


def _last(track):
    """The last valid step."""
    return int(np.flatnonzero(track.valid)[-1])


def corners(centre, yaw, length, width):
    """Corners of an oriented box, counter-clockwise."""
    forward = np.array([np.cos(yaw), np.sin(yaw)])
    along, across = forward * length / 2, np.array([-forward[1], forward[0]]) * width / 2
    return centre + np.stack([along - across, along + across, -along + across, -along - across])


def _agents(tracks, raw, origin, slots, car_size_m, start_speed):
    """Columns of `agents`. Absent slots hold zeros, and a size so that nobody divides by zero."""
    rows = {name: np.zeros((slots, 2)) for name in ("position", "goal")}
    rows |= {name: np.zeros(slots) for name in ("yaw", "speed", "route_length")}
    sizes = np.array([car_size_m or track.size[:2] for track in tracks], float).reshape(-1, 2)
    absent = car_size_m or (sizes.mean(axis=0) if len(sizes) else np.ones(2))
    size = np.concatenate([sizes, np.tile(absent, (slots - len(tracks), 1))])
    for slot, track in enumerate(tracks):
        path = track.xyz[raw.current :][track.valid[raw.current :], :2] - origin[:2]
        yaw = track.yaw[raw.current]
        along = float(track.velocity[raw.current] @ np.array([np.cos(yaw), np.sin(yaw)]))
        rows["position"][slot], rows["goal"][slot], rows["yaw"][slot] = path[0], path[-1], wrap_angles(yaw)
        rows["speed"][slot] = max(along, 0.0) if start_speed == "logged" else 0.0
        length = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
        rows["route_length"][slot] = max(length, np.linalg.norm(path[-1] - path[0]))
    present = np.arange(slots) < len(tracks)
    return {f"agents.{name}": leaf for name, leaf in (rows | {"size": size, "present": present}).items()}


def _log(tracks, raw, origin, slots, first):
    """Columns of `log`: zeros where the recording has nothing."""
    step = np.median(np.diff(raw.times)) if len(raw.times) > 1 else 1.0
    rows = _recording(tracks, raw, origin, slots, first)
    return {f"log.{name}": leaf for name, leaf in rows.items()} | {"log.dt": np.asarray(step)}


def _recording(tracks, raw, origin, slots, first):
    """What tracks did from a step on, in so many slots: zeros where the recording has nothing."""
    steps = len(raw.times) - first
    rows = {name: np.zeros((slots, steps, 2)) for name in ("position", "velocity")}
    rows |= {"yaw": np.zeros((slots, steps)), "valid": np.zeros((slots, steps), bool)}
    for slot, track in enumerate(tracks):
        valid = track.valid[first:]
        rows["valid"][slot] = valid
        rows["position"][slot][valid] = track.xyz[first:][valid, :2] - origin[:2]
        rows["yaw"][slot][valid] = wrap_angles(track.yaw[first:][valid])
        rows["velocity"][slot][valid] = track.velocity[first:][valid]
    return rows


def _choose_others(raw, agents, leaves, origin, half, limit, least):
    """Indices of the tracks that become others, nearest to an agent's start (without agents: to the centre) first, and the rest by reason.

    Whose box overlaps an agent's at the start is left out: the two would burst apart.
    """
    rows = [leaves[f"agents.{name}"][leaves["agents.present"]] for name in ("position", "yaw", "size")]
    boxes = np.array([corners(place, float(yaw), *size) for place, yaw, size in zip(*rows, strict=True)]).reshape(-1, 4, 2)
    starts = rows[0] if len(rows[0]) else np.zeros((1, 2))
    dropped, candidates = dict.fromkeys(TRAFFIC_DROPS, 0), []
    for index in sorted(set(range(len(raw.tracks))) - set(agents)):
        track = raw.tracks[index]
        now = track.valid[raw.current :]
        path = track.xyz[raw.current :, :2] - origin[:2]
        inside = now & (np.abs(path).max(axis=1) <= half)
        length, width = np.maximum(track.size[:2], least)
        if not now.any():
            dropped["absent_from_start_on"] += 1
        elif not inside.any():
            dropped["outside_box"] += 1
        elif now[0] and overlaps(corners(path[0], track.yaw[raw.current], length, width), boxes).any():
            dropped["overlaps_agent"] += 1
        else:
            near = np.linalg.norm(path[inside][:, None] - starts, axis=2).min()
            candidates.append((float(near), index))
    kept = [index for _, index in sorted(candidates)]
    dropped["over_capacity"] = max(len(kept) - limit, 0)
    return kept[:limit], dropped


def _others(raw, agents, leaves, origin, half, first, limit, least):
    """Columns of `others`, and who was left out, by reason."""
    chosen, dropped = _choose_others(raw, agents, leaves, origin, half, limit, least)
    tracks = [raw.tracks[i] for i in chosen]
    rows = _recording(tracks, raw, origin, len(tracks), first)
    rows["size"] = np.maximum(np.array([track.size[:2] for track in tracks], float).reshape(-1, 2), least)
    rows["kind"] = np.array([ROAD_USERS.index(track.kind) for track in tracks], int)
    cars = [track for track in raw.tracks if track.kind == "vehicle"]
    left = [track.kind == "vehicle" and any(drives_through(car, track) for car in cars) for track in tracks]
    rows["leaves"] = np.array(left, bool)
    return {f"traffic_log.{name}": leaf for name, leaf in rows.items()}, chosen, dropped


def drives_through(other, track):
    """Whether a track is within another's last box afterwards, and outside it at some time."""
    last, later, ever = _last(track), False, False
    for step in np.flatnonzero(other.valid):
        x, y, z = other.xyz[step] - track.xyz[last]
        turn = np.exp(-1j * track.yaw[last]) * (x + 1j * y)
        within = abs(turn.real) <= track.size[0] / 2 and abs(turn.imag) <= track.size[1] / 2 and abs(z) <= SAME_LEVEL_M
        later, ever = later or (within and step > last), ever or not within
    return later and ever


def lists(midpoint, valid, origin, *, side, radius_m, size_m):
    """Segments of all cells, cell after cell, and how many each has."""
    reach = int(np.ceil(radius_m / size_m)) + 1
    window = np.stack(np.meshgrid(*[np.arange(-reach, reach + 1)] * 2, indexing="xy"), axis=-1).reshape(-1, 2)
    number = np.flatnonzero(valid)
    points = midpoint[number].astype(np.float64) - origin
    cell = np.floor(points / size_m).astype(int)[:, None] + window
    beyond = np.maximum(np.maximum(cell * size_m - points[:, None], points[:, None] - (cell + 1) * size_m), 0.0)  # from point to square
    reached = (np.hypot(beyond[..., 0], beyond[..., 1]) <= radius_m + SLACK_M) & ((cell >= 0) & (cell < side)).all(axis=-1)
    flat = (cell[..., 1] * side + cell[..., 0])[reached]
    segment = np.broadcast_to(number[:, None], reached.shape)[reached]  # ascending, and a stable sort keeps it so
    return segment[np.argsort(flat, kind="stable")].astype(np.int32), np.bincount(flat, minlength=side * side)
