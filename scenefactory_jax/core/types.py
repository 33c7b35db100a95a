"""Types that several modules share.

Axes: `A` agent slots, `O` road users of the traffic, `P` road segments, `L` logged steps, `R` routes, `N` points of a route, `S` stop
lines of a route, `Z` zones of two routes, `C` traffic controls, `T` changes of a light, `K` rows of a set, `F` features. Code is written
for one world and `jax.vmap` adds the world axis `W`. SI units and radians, +x forward, +y left, yaw counter-clockwise from world x;
anything else carries a suffix (`film_mm`). What is missing is masked by a boolean, never marked by NaN or -1.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, Literal, NamedTuple, get_args

from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from scenefactory_jax.core.pytree import pytree_dataclass, static
from scenefactory_jax.core.route_types import GREEN_STATES as GREEN_STATES
from scenefactory_jax.core.route_types import LIGHT_STATES as LIGHT_STATES
from scenefactory_jax.core.route_types import RED_STATES as RED_STATES
from scenefactory_jax.core.route_types import ROUTE_SPACING_M as ROUTE_SPACING_M
from scenefactory_jax.core.route_types import YELLOW_STATES as YELLOW_STATES
from scenefactory_jax.core.route_types import LightState as LightState
from scenefactory_jax.core.route_types import Routes as Routes
from scenefactory_jax.core.route_types import RouteState as RouteState
from scenefactory_jax.core.route_types import TrafficControls as TrafficControls
from scenefactory_jax.core.route_types import make_empty_rows

SurfaceName = Literal["AC", "SMA", "OGFC", "GRAVEL", "SNOW", "ICE"]  # the first three are asphalts: concrete, stone mastic, open-graded
SURFACES: tuple[SurfaceName, ...] = get_args(SurfaceName)

RoadUser = Literal["vehicle", "pedestrian", "cyclist", "other"]
ROAD_USERS: tuple[RoadUser, ...] = get_args(RoadUser)  # the order of `Tracks.kind`

# WOMD map element ids: the `kind` of a road segment (Waymo Open Motion Dataset, map.proto and GPUDrive's MapElementIds)
LANE_FREEWAY, LANE_STREET, LANE_BIKE = 1, 2, 3
LINES = tuple(range(6, 14))
EDGE_BOUNDARY, EDGE_MEDIAN = 15, 16
STOP_SIGN, CROSSWALK, SPEED_BUMP, DRIVEWAY = 17, 18, 19, 20
DRIVABLE = (LANE_FREEWAY, LANE_STREET)
POLYGONS = (CROSSWALK, SPEED_BUMP, DRIVEWAY)
EDGES = (EDGE_BOUNDARY, EDGE_MEDIAN)


@pytree_dataclass
class Road:
    """Road segments in storage order: kind ascending, then polyline order, then along the polyline."""

    midpoint: Float[Array, "P 2"]
    direction: Float[Array, "P 2"]  # unit, from the first to the second point
    half_length: Float[Array, " P"]
    kind: Int[Array, " P"]
    polyline: Int[Array, " P"]  # index into RawScene.roads
    arc: Float[Array, " P"]  # arc length along the polyline at the midpoint
    valid: Bool[Array, " P"]
    height: Float[Array, " P"] | None = None  # of the midpoint; None: the scene has one level


@pytree_dataclass
class Agents:
    """Starts and goals of an episode's agents."""

    position: Float[Array, "A 2"]
    yaw: Float[Array, " A"]
    speed: Float[Array, " A"]
    size: Float[Array, "A 2"]  # length, width
    goal: Float[Array, "A 2"]
    route_length: Float[Array, " A"]  # from start to goal, m
    present: Bool[Array, " A"]
    route: Int[Array, " A"]  # row of `Scene.routes`
    route_start: Float[Array, " A"]  # arc length on the route at the start
    route_end: Float[Array, " A"]  # at the goal; not above `route_start`: the agent has no route


@pytree_dataclass
class AgentLog:
    """Logged tracks of the agents, at the source's own time step."""

    position: Float[Array, "A L 2"]
    yaw: Float[Array, "A L"]
    velocity: Float[Array, "A L 2"]
    valid: Bool[Array, "A L"]
    dt: Float[Array, ""]


@pytree_dataclass
class TrafficLog:
    """Logged tracks of all road users that are not agents, at the time steps of `AgentLog`."""

    position: Float[Array, "O L 2"]
    yaw: Float[Array, "O L"]
    velocity: Float[Array, "O L 2"]
    valid: Bool[Array, "O L"]
    size: Float[Array, "O 2"]  # length, width
    kind: Int[Array, " O"]  # index into ROAD_USERS
    route: Int[Array, " O"]  # row of `Scene.routes`
    has_route: Bool[Array, " O"]
    leaves: Bool[Array, " O"]  # whether a vehicle's logged way leads through the last place later: who stood there has left it
    # The first stretches where the row's route and the column's are too near for both vehicles, as arc lengths on the row's route
    zone_enter: Float[Array, "O O Z"]  # inf: there is none
    zone_leave: Float[Array, "O O Z"]
    zone_match: Float[Array, "O O Z"]  # the same place as that of the column's row, where both routes lead the same way; inf: they cross


@pytree_dataclass
class Patches:
    """Regions of the road with a condition of their own; where they overlap the last one counts.

    All have one form: the points within `radius` of a line of vertices and, if it is `closed`, the points inside it. A circle is one
    vertex repeated, a strip an open line with half its width, a polygon a closed line with radius 0.
    """

    vertices: Float[Array, "N V 2"]
    closed: Bool[Array, " N"]
    radius: Float[Array, " N"]
    surface: Int[Array, " N"]  # index into SURFACES
    film_mm: Float[Array, " N"]
    open_road_film_fraction: Float[Array, " N"]  # part of the open road's film added to `film_mm`: 1 in a puddle
    present: Bool[Array, " N"]


@pytree_dataclass
class Rain:
    """Water film of the open road over an episode: linear between knots, constant beyond them and without any."""

    now_s: Float[Array, ""]  # since the episode began
    time_s: Float[Array, " K"]  # of the knots, ascending
    film_mm: Float[Array, " K"]


@pytree_dataclass
class Weather:
    """Road condition of one world, over the plane and over time; `surface` indexes SURFACES."""

    film_mm: Float[Array, ""]  # on the open road, now
    surface: Int[Array, ""]  # of the open road
    patches: Patches
    rain: Rain


@pytree_dataclass
class Boxes:
    """Oriented boxes on the road at one time: cars, and what they can hit."""

    position: Float[Array, "B 2"]
    elevation: Float[Array, " B"]  # of the boxes' centres
    yaw: Float[Array, " B"]
    velocity: Float[Array, "B 2"]
    yaw_rate: Float[Array, " B"]
    size: Float[Array, "B 2"]  # length, width
    mass: Float[Array, " B"]  # inf: immovable
    present: Bool[Array, " B"]


@pytree_dataclass
class SpatialGrid:
    """A square grid over the road: for each cell, row after row, the segments within a radius of any of its points, in storage order.

    The cells at the edge list nothing and stand for everything beyond them, too.
    """

    origin: Float[Array, "2"]  # corner of the first cell
    first: Int[Array, " N"]  # where each cell's list begins in `rows`, and where the last one ends
    rows: Int[Array, " M"]  # of the road
    side: int = static()  # cells
    size_m: float = static()
    radius_m: float = static()
    longest_list: int = static()  # entries of the longest list


@pytree_dataclass
class Elevation:
    """Heights of the road as quadratic B-splines over a square grid, on one or more levels; see `roadgraph.elevation`."""

    height: Float[Array, "V Y X"]  # coefficients, level after level, m
    origin: Float[Array, "2"]  # place of the first coefficient
    cell_m: Float[Array, ""]  # between coefficients
    present: Bool[Array, "V Y X"] | None = None  # the level is there, in the cell around the coefficient; None: everywhere


@pytree_dataclass
class Scene:
    """The data of one world: constant in an episode, except for agents and weather, which a reset may sample again, and the traffic boxes.

    `lanes` (kinds DRIVABLE) and `edges` (kinds EDGES) repeat rows of `road`, so that a query of the nearest lane or edge reads
    nothing else. Coordinates are metres around the scene's centre.
    """

    road: Road
    lanes: Road
    edges: Road
    agents: Agents
    log: AgentLog
    weather: Weather
    traffic_log: TrafficLog
    traffic: Boxes  # at the present time; set by the environment
    routes: Routes = dataclasses.field(default_factory=lambda: make_empty_rows(Routes))
    controls: TrafficControls = dataclasses.field(default_factory=lambda: make_empty_rows(TrafficControls))
    road_grid: SpatialGrid | None = None  # of `road`, for queries within a radius; None: they read all of it
    elevation: Elevation | None = None  # None: the road is flat, at height 0


@pytree_dataclass
class Motion:
    """The state of a car that all dynamics backends provide."""

    position: Float[Array, "A 3"]  # centre of the chassis box
    velocity: Float[Array, "A 3"]  # world frame
    yaw: Float[Array, " A"]
    yaw_rate: Float[Array, " A"]
    upright: Float[Array, " A"]  # cosine between the car's and the world's up
    steer: Float[Array, " A"]  # mean angle of the front wheels
    contact_force: Float[Array, " A"]  # largest force of another car or box in the last control step, N
    mu: Float[Array, " A"]  # friction coefficient, mean over the wheels
    friction_utilization: Float[Array, " A"]  # tangential force / (friction x normal force), largest over the wheels
    slip: Float[Array, " A"]  # |wheel surface speed - ground speed|, largest over the wheels, m/s


@pytree_dataclass
class Events:
    """Events of an agent. At most one is true in one step: the order of the fields is the order of precedence."""

    numerical_error: Bool[Array, " A"]
    goal_reached: Bool[Array, " A"]
    collision: Bool[Array, " A"]
    out_of_bounds: Bool[Array, " A"]
    road_edge_contact: Bool[Array, " A"]
    red_light: Bool[Array, " A"]  # the car's front passed a stop line while its light was red
    stop_sign: Bool[Array, " A"]  # the car's front passed the line of a stop sign without having stood before it
    off_route: Bool[Array, " A"]  # the car is farther from its route than `step_metrics.off_route_m`


@pytree_dataclass
class StepMetrics:
    """Quantities computed once per control step; rewards, termination, evaluations and reports read them."""

    speed: Float[Array, " A"]
    goal_distance: Float[Array, " A"]
    progress: Float[Array, " A"]  # metres along the nearest lane, towards the goal
    lane_offset: Float[Array, " A"]  # lateral distance from the nearest lane segment's line
    lane_distance: Float[Array, " A"]  # distance from its midpoint
    lane_alignment: Float[Array, " A"]  # cosine between the car and the lane, towards the goal
    lane_heading: Float[Array, " A"]  # cosine between the car and the lane's own direction: negative against the traffic
    has_lane: Bool[Array, " A"]
    ttc: Float[Array, " A"]  # time to collision with the nearest other car or box, inf if none
    clearance: Float[Array, " A"]  # between the bounding circles and those of the nearest other car or box; inf if none
    stopping_margin: Float[Array, " A"]  # free distance ahead less the stopping distance; inf if free
    edge_ttc: Float[Array, " A"]
    edge_clearance: Float[Array, " A"]  # between the bounding circles and the nearest road edge; negative once touched
    drac: Float[Array, " A"]  # deceleration rate to avoid a crash, m/s^2
    distance_from_start: Float[Array, " A"]  # distance from the start
    contact_force: Float[Array, " A"]
    mu: Float[Array, " A"]
    friction_utilization: Float[Array, " A"]
    slip: Float[Array, " A"]
    off_lane: Bool[Array, " A"]
    idle: Bool[Array, " A"]
    has_route: Bool[Array, " A"]
    route_arc: Float[Array, " A"]  # arc length on the route at the car's nearest point, m
    route_progress: Float[Array, " A"]  # by which it grew in this step
    route_remaining: Float[Array, " A"]  # from there to the goal
    route_completion: Float[Array, " A"]  # part of the route between start and goal that the car has been on, 0 to 1
    route_distance: Float[Array, " A"]  # from the route's line
    route_alignment: Float[Array, " A"]  # cosine between the car and the route
    wrong_way: Bool[Array, " A"]  # it drives against the direction of the lane that it is on
    overspeed: Float[Array, " A"]  # speed above the limit, at least 0, m/s
    events: Events  # raw: several may be true at once


@pytree_dataclass
class State:
    """The variable state of a world."""

    body: Any  # the dynamics backend's own pytree
    motion: Motion
    agents: Agents  # this episode's starts and goals
    weather: Weather  # this episode's road condition
    active: Bool[Array, " A"]  # present and not terminated
    past_events: Events  # since the agent's start
    steps_since_spawn: Int[Array, " A"]  # control steps
    previous_action: Float[Array, "A 3"]
    step: Int[Array, ""]
    key: PRNGKeyArray
    route: RouteState
    traffic: Any = ()  # the background traffic's own pytree
    history: Any = ()  # past positions, where an observation needs them
    reward_weights: Any = ()  # those that agents drew, term -> Float[Array, "A"], where a reward term has a range of weights


@pytree_dataclass
class RewardInput:
    """The input of a reward term."""

    scene: Scene
    before: State
    action: Float[Array, "A 3"]
    after: State
    metrics: StepMetrics
    events: Events  # new in this step and exclusive


@pytree_dataclass
class SetObservation:
    """A padded set of feature rows, one set per agent: road segments, neighbours."""

    features: Float[Array, "*agents K F"]
    mask: Bool[Array, "*agents K"]


Observation = dict[str, Any]
"""Group name -> Float[Array, "A F"], SetObservation or, of groups for planners, another pytree of arrays [A, ...].

Inactive agents read zeros and false masks.
"""


@pytree_dataclass
class StepResult:
    """The result of an action or of a control step. `observation` is None for a control step."""

    observation: Observation | None
    reward: Float[Array, " A"]
    terms: dict[str, Float[Array, " A"]]  # weighted reward terms; they sum to `reward`
    events: Events
    terminated: Bool[Array, " A"]  # an event ended the agent in this step
    truncated: Bool[Array, ""]  # the world reached the time limit
    world_done: Bool[Array, ""]  # truncated, or no agent is active
    metrics: StepMetrics


class Dynamics(NamedTuple):
    """A backend: cars of one world. `advance` covers one control step; bodies of inactive cars are held, without contacts."""

    init: Callable[[PRNGKeyArray, Scene], Any]
    advance: Callable[[Scene, Any, Float[Array, "A 3"], Bool[Array, " A"]], Any]  # (scene, body, action, active) -> body
    read: Callable[[Any], Motion]


class PastPolicies(NamedTuple):
    """Where background traffic is driven by past policies of a training, whose parameters are arguments of its compiled functions.

    `bind` gives the traffic, or the environment, that has them: (parameters along the first axis, which of them there are yet) -> it. The
    traffic without them has no past policies; its states are other ones.
    """

    slots: int  # policies that are kept
    every: int  # iterations after which the newest replaces the oldest
    bind: Callable[[Any, Bool[Array, " P"]], Any]


class Traffic(NamedTuple):
    """Background traffic of one world: its own state, what moves it by one control step, and its boxes on the road."""

    init: Callable[[PRNGKeyArray, Scene, Int[Array, ""]], Any]  # (key, scene, control step) -> state
    advance: Callable[[Scene, Any, Boxes, Int[Array, ""]], Any]  # (scene, state, active agents, control step) -> state one step later
    read: Callable[[Scene, Any, Int[Array, ""]], Boxes]  # (scene, state, control step) -> its boxes
    past: PastPolicies | None = None
    on_road: bool = False  # elevations are heights of the world; False: above a flat road, and the environment adds the road's


class Env(NamedTuple):
    """One world as pure functions. `reset` and `step` are the public pair: a step is an action, with all its `action_repeat` control
    steps, their rewards added up.

    The other functions are their parts: `init_state` and `observe` divide a reset, so that training restarts finished worlds before it
    computes the observation; `control_step` is a single control step. It reads every `action_repeat`-th action of an
    episode, the first one first, and holds it until the next; `respawn` ends an action: it starts finished agents again, where
    `spawning.respawn_clearance_m` asks for it. `current_scene` gives the scene at the time of a state.

    All of them take arrays of numpy or JAX, also closed over, and raise ValueError when they are traced with an argument of another shape
    or kind of number than is annotated here. Values are not checked: an agent that starts with a number that is not finite, or with a size
    of 0 or less, is absent; one that gets such a number later has the event `numerical_error`.
    """

    reset: Callable[[PRNGKeyArray, Scene], tuple[State, Observation]]
    step: Callable[[Scene, State, Float[Array, "A 3"]], tuple[State, StepResult]]
    init_state: Callable[..., State]  # (key, scene, control step at which it begins = 0)
    control_step: Callable[[Scene, State, Float[Array, "A 3"]], tuple[State, StepResult]]
    respawn: Callable[[Scene, State], State]
    observe: Callable[[Scene, State], Observation]
    current_scene: Callable[[Scene, State], Scene]
    action_repeat: int = 1
    past: PastPolicies | None = None  # of the background traffic; a training binds them


class Policy(NamedTuple):
    """`apply(parameters, observation) -> (mean [..., 3], log_std [3] or [..., 3], value [...])` for any leading axes; several values:
    [..., values].

    A logarithm of -inf is that of a policy without noise, as a planner; actions of a squashed Gaussian are sampled from `networks`.
    """

    init: Callable[[PRNGKeyArray, Observation], Any]
    apply: Callable[[Any, Observation], tuple[Array, Array, Array]]
    networks: Any = None  # `learning.networks.squashed.Networks` of the learners that need more than `apply`
    encoder: Any = None  # `learning.networks.heads.Encoder`: makes another one as the policy's, for networks that a learner adds
