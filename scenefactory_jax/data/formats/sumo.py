"""SUMO: networks (`.net.xml`), and recordings of its vehicles and persons (`--fcd-output`, XML or CSV) on the network beside them.

SUMO writes its configuration into a recording, with the names of the network and of the files that have the sizes of vehicles. A position
is the middle of a vehicle's front bumper, an angle is in degrees clockwise from north (SUMO, "FCD output"). Vehicles change lanes in one
step unless SUMO ran with `--lanechange.duration` or with sublanes.
"""

import csv
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import KDTree

from scenefactory_jax.core.raw_scene import Companion, FormatMismatch, Light, RawScene, Reject, SceneError, Track
from scenefactory_jax.core.scene_arrays import wrap_angles
from scenefactory_jax.core.types import RoadUser
from scenefactory_jax.data.formats import file_content, scene_parts, sumo_net, xml_content
from scenefactory_jax.data.formats.drivable_outline import OutlineNumbers
from scenefactory_jax.data.formats.sumo_net import Net
from scenefactory_jax.data.formats.xml_content import Element
from scenefactory_jax.data.generators import map_traffic

RECORDING, TABLE = "fcd-export", b"timestep_time"  # root of the XML, first column of the CSV
TYPES = ("routes", "additional")  # roots of files with types of vehicles
BESIDE = re.compile(r"\.(xml|csv)(\.gz)?$")  # names of files that SUMO reads or writes
CONFIGURED = re.compile(r'<(net-file|route-files|additional-files) value="([^"]*)"')  # in the comment at the head of what SUMO writes
STEP_LENGTH = re.compile(r'<step-length value="([\d.]+)"')
OTHER_FILES = re.compile(
    r"<(?:\w+:)?(routes|additional|add|configuration|sumoConfiguration|trips|flows|tazs|tlsStates|tlLogic|viewsettings|nodes|edges|"
    r"connections|types)[\s/>]"
)
COLUMNS = ("id", "x", "y", "angle", "speed")  # of a recording that are needed
DEFAULT_PERSON = "DEFAULT_PEDTYPE"
DEFAULTS = {DEFAULT_PERSON: "pedestrian", "DEFAULT_BIKETYPE": "bicycle", "DEFAULT_TAXITYPE": "taxi", "DEFAULT_RAILTYPE": "rail"}
KINDS: dict[str, RoadUser] = {
    "pedestrian": "pedestrian", "wheelchair": "pedestrian", "bicycle": "cyclist", "scooter": "cyclist", "moped": "cyclist",
    "motorcycle": "cyclist",
}  # fmt: skip
OUTSIDE_M = 1000.0  # a recording whose nearest position is farther from its network has other coordinates
NEAR = 0.02  # fraction of a step by which times may be off


class _Row(NamedTuple):
    """A road user at one time; what is needed of the values is text, checked when it is used."""

    time: float
    user: str  # "vehicle ID" or "person ID"
    type: str
    state: tuple[float, float, float, float, float]  # x, y, z (NaN: on the ground), angle, speed


class _User(NamedTuple):
    """A road user's states at the times of the recording."""

    id: int
    where: str  # for messages
    kind: RoadUser
    size: list[float]
    clock: np.ndarray  # [K], s
    xyz: np.ndarray  # [K, 3], of its box's centre
    yaw: np.ndarray  # [K], without jumps
    velocity: np.ndarray  # [K, 2]


def read(
    path: Path,
    *,
    step_s: float,
    steps: int,
    current: int,
    sizes_m: dict[str, list[float]],
    point_spacing_m: float,
    outline: OutlineNumbers,
    row_limit: int,
    element_limit: int,
    file_limit_mb: int,
    traffic: dict[str, Any] | None,
) -> Iterator[RawScene | Reject]:
    """Reads the scenes of a recording, or draws scenes on a network without one.

    Args:
        path, step_s, current, point_spacing_m, file_limit_mb: see `formats`; recordings of other steps are interpolated.
        steps: of a scene; what is left at the end of a recording makes none.
        sizes_m: length, width, height by the class of a vehicle, where its type has no other.
        outline, element_limit, traffic: as of `opendrive.read`.
        row_limit: longer recordings are refused.
    """
    limits = {"element_limit": element_limit, "file_limit_mb": file_limit_mb}
    numbers = {"point_spacing_m": point_spacing_m, "outline": outline, **limits}
    rows = _read_rows(path, row_limit, limits)
    if rows is not None:
        if not 0 <= current < steps:
            raise SceneError(f"{path}: formats.sumo.current: expected a step of a scene, 0 to {steps - 1}, got {current}")
        yield from _cut_scenes(path, rows, numbers, step_s=step_s, steps=steps, current=current, sizes=sizes_m)
        return
    try:
        net = sumo_net.read_net(path, **numbers)
    except FormatMismatch:
        if OTHER_FILES.search(_read_start(path)) and any(_is_net(file) for file in _list_beside(path)):
            raise Companion(f"{path}: a file of a simulation of SUMO, whose network lies beside it") from None
        raise
    recordings = (one for one in _list_beside(path) if _has_root(one, RECORDING) or _read_start(one).startswith(TABLE.decode()))
    if any(_find_net(file) == Path(path) for file in recordings):
        raise Companion(f"{path}: the network of recordings of SUMO beside it")
    lights = [Light(s.lane, np.zeros(1, int), np.zeros(1, bool), s.stop, s.plan) for s in net.signals if s.plan is not None]
    dark = [[[s.lane]] for s in net.signals if s.plan is None]
    yield from map_traffic.draw(_make_scene(path, net, name=_stem(path), times=np.zeros(1), lights=tuple(lights)), dark, traffic)


def _make_scene(path: Path, net: Net, *, name: str, times: np.ndarray, lights: tuple[Light, ...], **entries: Any) -> RawScene:
    """A scene on a network."""
    metadata = {"dataset": "sumo", "format": "sumo", "intersection_lanes": net.inside, "left_out": net.left_out}
    tokens = {"features": scene_parts.list_tokens(net.ids)} | entries.pop("tokens", {})
    known = {"tracks": (), "current": 0} | entries
    metadata |= known.pop("metadata", {}) | {"tokens": tokens}
    return RawScene(name=name, source=str(path), roads=net.roads, times=times, lights=lights, origin=net.origin, metadata=metadata, **known)


# ---- files


def _stem(path: Path) -> str:
    """A file's name without what says that it is SUMO's."""
    return re.sub(r"(\.net|\.fcd)?\.(xml|csv)$", "", Path(path).name.removesuffix(".gz"))


def _read_start(path: Path) -> str:
    """The text at the head of a file, with the configuration that SUMO writes there."""
    return file_content.read_head(path).decode("utf-8", errors="ignore")


def _list_beside(path: Path) -> list[Path]:
    """The files of the same folder that SUMO may have written."""
    return sorted(file for file in Path(path).absolute().parent.iterdir() if BESIDE.search(file.name) and file.is_file())


def _has_root(path: Path, root: str) -> bool:
    return re.search(rf"<{root}[\s/>]", _read_start(path)) is not None


def _is_net(path: Path) -> bool:
    return ".net.xml" in path.name or _has_root(path, sumo_net.ROOT)


def _find_net(path: Path) -> Path | None:
    """The network of a recording: that of its configuration or of its own name, or the only one in its folder."""
    nets = [file for file in _list_beside(path) if _is_net(file)]
    named = [Path(value).name for key, value in CONFIGURED.findall(_read_start(path)) if key == "net-file"]
    chosen = [file for file in nets if file.name in named] or [file for file in nets if _stem(file) == _stem(path)] or nets
    return chosen[0] if len(chosen) == 1 else None


def _find_step_length(path: Path, every: float) -> float:
    """The step of the simulation, by which its lights are ahead: at time t, SUMO moves vehicles by the lights of t, then writes."""
    start = _read_start(path)
    found = STEP_LENGTH.search(start)
    usual = 1.0 if CONFIGURED.search(start) else every  # SUMO writes what is not its default
    return usual if found is None else float(found[1])


def _read_types(path: Path, limits: Mapping[str, int]) -> dict[str, Element]:
    """The types of vehicles by name, from the files of the recording's configuration, or else from all beside it."""
    named = {Path(v).name for key, value in CONFIGURED.findall(_read_start(path)) if key != "net-file" for v in value.split(",")}
    beside = [file for file in _list_beside(path) if any(_has_root(file, root) for root in TYPES)]
    types: dict[str, Element] = {}
    for file in [file for file in beside if file.name in named] or beside:
        root = next(root for root in TYPES if _has_root(file, root))
        document = xml_content.load(file, root, **limits)
        records = [*document.all("vType"), *document.walk("vTypeDistribution", "vType")]
        types |= {record.get("id"): record for record in records}
    return types


# ---- recordings


def _read_rows(path: Path, row_limit: int, limits: Mapping[str, int]) -> list[_Row] | None:
    """The rows of a recording; None: the file is none."""
    if file_content.read_head(path).removeprefix(b"\xef\xbb\xbf").startswith(TABLE):
        rows = _read_table(path, limits["file_limit_mb"])
    else:
        try:
            document = xml_content.load(path, RECORDING, **limits)
        except FormatMismatch:
            return None
        rows = _read_document(document)
    found = []
    for row in rows:
        if len(found) == row_limit:
            raise SceneError(f"{path}: expected up to {row_limit} states (formats.sumo.row_limit), got more")
        found.append(row)
    if not found:
        raise SceneError(f"{path}: expected vehicles, got none")
    return found


def _read_document(document: Element) -> Iterator[_Row]:
    for step in document.all("timestep"):
        time = step.number("time")
        for record in step.all("vehicle", "person"):
            height = record.number("z") if "z" in record.attributes else np.nan
            x, y, angle, speed = (record.number(key) for key in COLUMNS[1:])
            default = DEFAULT_PERSON if record.tag == "person" else ""
            yield _Row(time, f"{record.tag} {record.get('id')}", record.get("type", default), (x, y, height, angle, speed))


def _read_table(path: Path, file_limit_mb: int) -> Iterator[_Row]:
    """The rows of a CSV table; before SUMO 1.20 persons have columns of their own."""
    text = file_content.unpack(path, file_limit_mb=file_limit_mb).decode("utf-8-sig", errors="replace")
    lines = text.splitlines()
    table = csv.DictReader(lines, delimiter=";" if ";" in lines[0] else ",")
    try:
        for line, row in enumerate(table, start=2):
            for tag in ("vehicle", "person"):
                if not row.get(f"{tag}_id"):
                    continue
                numbers = [row.get("timestep_time"), *(row.get(f"{tag}_{key}") for key in COLUMNS[1:])]
                try:
                    time, x, y, angle, speed = (float(number or "") for number in numbers)
                    height = float(row.get(f"{tag}_z") or "nan")
                except ValueError:
                    keys = ", ".join(["timestep_time", *(f"{tag}_{key}" for key in COLUMNS[1:])])
                    raise SceneError(f"{path}: line {line}: expected numbers as {keys}, got {numbers}") from None
                walks = tag == "person" or bool(row.get("vehicle_edge") and not row.get("vehicle_lane"))
                kind = row.get(f"{tag}_type") or (DEFAULT_PERSON if walks else "")
                yield _Row(time, f"{'person' if walks else 'vehicle'} {row[f'{tag}_id']}", kind, (x, y, height, angle, speed))
    except csv.Error as error:
        raise SceneError(f"{path}: not a valid table, damaged: {error}") from error


def _cut_scenes(
    path: Path, rows: Sequence[_Row], numbers: dict[str, Any], *, step_s: float, steps: int, current: int, sizes: Mapping[str, list[float]]
) -> Iterator[RawScene]:
    """The scenes of a recording, one after another; in each the vehicle that drives farthest, of those present all along, is the `sdc`."""
    source = _find_net(path)
    if source is None:
        raise SceneError(f"{path}: its network is missing: expected the .net.xml of its configuration, or one alone, in its folder")
    net = sumo_net.read_net(source, **numbers)
    clock = np.unique([row.time for row in rows])
    if len(clock) < 2 or not np.isfinite(clock).all():
        raise SceneError(f"{path}: expected two times or more, finite, got {len(clock)}")
    every = float(np.median(np.diff(clock)))
    count = (clock[-1] - clock[0]) / step_s + NEAR + 1
    if count > len(rows) * max(every / step_s, 1.0):
        raise SceneError(f"{path}: expected states at most steps of {every:g} s, got {len(rows)} over {clock[-1] - clock[0]:g} s")
    lead, made = _find_step_length(path, every), 0
    users = _make_users(path, rows, every, net, sizes, numbers)
    tokens = {"tracks": scene_parts.list_tokens({name: user.id for name, user in users.items()})}
    for number in range(int(count) // steps):
        times = clock[0] + step_s * (steps * number + np.arange(steps))
        present = (user for user in users.values() if user.clock[0] < times[-1] + step_s and user.clock[-1] > times[0] - step_s)
        part = scene_parts.cut_tracks([_make_track(user, times, every) for user in present], slice(None))
        sdc = scene_parts.choose_recording_car(part)
        if sdc is None:
            continue
        made += 1
        yield _make_scene(
            path,
            net,
            name=f"{_stem(path)}-{number}",
            times=step_s * np.arange(steps),
            lights=tuple(_show_lights(net, times + lead)),
            tracks=tuple(part),
            current=current,
            sdc=sdc,
            tokens=tokens,
            metadata={"map": source.name, "first_time_s": float(times[0])},
        )
    if not made:
        got = f"{len(users)} road users over {clock[-1] - clock[0]:g} s"
        raise SceneError(f"{path}: expected a vehicle that is present for {steps} steps of {step_s:g} s, got {got}")


def _show_lights(net: Net, times: np.ndarray) -> Iterator[Light]:
    """The lights at times of SUMO's clock; those whose programs depend on the traffic show nothing."""
    for signal in net.signals:
        if signal.plan is None or not signal.fixed:
            yield Light(signal.lane, np.zeros(len(times), int), np.zeros(len(times), bool), signal.stop)
        else:
            states = map_traffic.read_plan(signal.plan, times + 1e-6)
            yield Light(signal.lane, states, np.ones(len(times), bool), signal.stop, sumo_net.shift_plan(signal.plan, float(times[0])))


def _make_users(
    path: Path, rows: Sequence[_Row], every: float, net: Net, sizes: Mapping[str, list[float]], numbers: Mapping[str, Any]
) -> dict[str, _User]:
    """The road users of a recording, in the order of their first states."""
    types = _read_types(path, {key: numbers[key] for key in ("element_limit", "file_limit_mb")})
    ground = np.concatenate([line.xyz for line in net.roads[: len(net.ids)]])
    tree = KDTree(ground[:, :2])
    owned: dict[str, list[_Row]] = {}
    for row in rows:
        owned.setdefault(row.user, []).append(row)
    users = {}
    for number, (name, own) in enumerate(owned.items()):
        record, tag = types.get(own[0].type.partition("@")[0]), name.partition(" ")[0]  # "@": of a type that a script changed
        default = DEFAULTS.get(own[0].type, "pedestrian" if tag == "person" else "passenger")
        vclass = default if record is None else record.get("vClass", default)
        usual = sizes.get(vclass, sizes["passenger"])
        size = [usual[i] if record is None else record.number(key, usual[i]) for i, key in enumerate(("length", "width", "height"))]
        clock, index = np.unique([row.time for row in own], return_index=True)
        table = np.array([own[i].state for i in index])
        yaw = np.unwrap(np.deg2rad(90.0 - table[:, 3]))
        along = np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
        centre = table[:, :2] - size[0] / 2 * along
        distance, nearest = tree.query(centre)
        if not distance.min() <= OUTSIDE_M:
            got = f"{name[:40]!r} {distance.min():.3g} m away or more"
            raise SceneError(f"{path}: expected positions on the network (without --fcd-output.geo), got {got}")
        height = np.where(np.isnan(table[:, 2]), ground[nearest, 2], table[:, 2]) + size[2] / 2
        kind = KINDS.get(vclass, "vehicle" if tag == "vehicle" else "pedestrian")
        velocity = table[:, 4:] * along
        users[name] = _User(number, f"{path}: {name[:40]}", kind, size, clock, np.column_stack([centre, height]), yaw, velocity)
    return users


def _make_track(user: _User, times: np.ndarray, every: float) -> Track:
    """The track of a road user: cubic between its states, with their velocities, where they are one step apart."""
    before = np.clip(np.searchsorted(user.clock, times + NEAR * every, side="right") - 1, 0, max(len(user.clock) - 2, 0))
    after = np.minimum(before + 1, len(user.clock) - 1)
    span = np.maximum(user.clock[after] - user.clock[before], 1e-9)
    u = np.clip((times - user.clock[before]) / span, 0.0, 1.0)[:, None]
    valid = (times >= user.clock[0] - NEAR * every) & (times <= user.clock[-1] + NEAR * every)
    valid &= (span <= 1.5 * every) | (np.minimum(u[:, 0], 1 - u[:, 0]) * span <= NEAR * every)
    mix = lambda table: table[before] + u * (table[after] - table[before])  # noqa: E731
    xyz, velocity = mix(user.xyz), user.velocity
    xyz[:, :2] = user.xyz[before, :2] * (2 * u**3 - 3 * u**2 + 1) + user.xyz[after, :2] * (3 * u**2 - 2 * u**3)
    xyz[:, :2] += span[:, None] * (velocity[before] * (u**3 - 2 * u**2 + u) + velocity[after] * (u**3 - u**2))
    entries = {"position": xyz, "heading": wrap_angles(mix(user.yaw[:, None])[:, 0]), "velocity": mix(velocity), "valid": valid}
    return scene_parts.make_track(user.where, id=user.id, kind=user.kind, size=user.size, **entries)
