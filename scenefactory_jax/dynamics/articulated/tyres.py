"""The tyres: contact patches, normal force, and a tangential force with state.

A tyre is an ellipsoid with its short axis along the axle, pressed into a plane. Its normal force is a MuJoCo constraint, one row in closed
form: J, a_ref and D. a_ref = -b J v - k r, with k and b from `solref`, and D from the impedance `solimp` and the inverse weight (MuJoCo
documentation, "Computation", constraint model, and "Modeling", solver parameters).

The tangential force is that of a tread which deflects. z is the deflection of the tread over the road, m, forward and left in the wheel's
axes, and u the slip velocity: that of the tyre's material at the contact over the road, m/s.

    dz/dt = u - |V| z / L                     V: rolling speed radius x spin; L: relaxation length
    F = -F_peak fall g(r) z / |z|             r = (C / F_peak) |z| / L <= r_peak = c tan(pi / (2 c))
    g(r) = sin(c arctan(r / c))               c: shape factor; g(r_peak) = 1
    C = stiffness x load x (1 - e x)          slip stiffness; x = load / nominal load - 1
    F_peak = mu x load x (1 - q x)
    fall = s + (1 - s) exp(-v / v_fall)       v = max(0, |u| - r_peak (F_peak / C) |V|): sliding speed beyond the peak

In steady rolling z / L is the slip, and F is the magic formula of that slip with no curvature factor. A locked wheel slides. A wheel at
rest is a spring of stiffness C / L. One circle holds both directions.

Sources: H. B. Pacejka, Tyre and Vehicle Dynamics, 3rd edition, equation 1.6 (magic formula), section 4.3 (combined slip by one normalised
slip), chapter 7 (relaxation length); C. Canudas de Wit et al., "A new model for control of systems with friction", IEEE Transactions on
Automatic Control 40, 1995 (a deflection as the state of friction, which falls with the sliding speed).
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from scenefactory_jax.core.pytree import pytree_dataclass
from scenefactory_jax.dynamics.articulated import equations_of_motion
from scenefactory_jax.dynamics.articulated.constants import CarConstants
from scenefactory_jax.dynamics.articulated.contact_solver import IMPEDANCE_RANGE, MIN_REGULARIZATION, NormalRows
from scenefactory_jax.dynamics.articulated.equations_of_motion import FRONT, Forces
from scenefactory_jax.dynamics.articulated.parameters import GRAVITY, CarParameters
from scenefactory_jax.dynamics.articulated.state import CarState
from scenefactory_jax.dynamics.articulated.vector import Number, Vector, cross, dot, length, sum_vectors

NEWTON_STEPS = 4  # of the equation of a wheel
MIN_LOAD_FACTOR = 0.3  # of load sensitivity


@pytree_dataclass
class Tyres:
    """State and outputs of the tyres after a physics step, in the order of `WHEELS`."""

    forward: Float[Array, "*cars 4"]  # deflection, m
    left: Float[Array, "*cars 4"]
    normal: Float[Array, "*cars 4"]  # force, N
    mu: Float[Array, "*cars 4"]  # friction coefficient under the wheel
    tangent: Float[Array, "*cars 4"]  # force, N
    slip: Float[Array, "*cars 4"]  # speed of the tyre's material over the road, m/s; zero in the air


class Patch(NamedTuple):
    """Contact patches of the four tyres, in the car's axes."""

    depth: Number  # of the tyre in the road, m; below zero in the air
    arm: Vector  # from the hub to the contact, halfway between the road and the tyre's lowest point, m
    velocity: Vector  # of the tyre at the contact, m/s
    forward: Vector  # direction of rolling in the plane of the road
    left: Vector


class Limits(NamedTuple):
    """What a tyre can transmit in a step."""

    stiffness: Number  # at small deflections, N/m
    peak: Number  # largest force, N
    fall: Number  # sliding friction over the peak
    shape: Number  # c


class TyreForces(NamedTuple):
    """Tangential forces of a step."""

    deflection: tuple[Number, Number]  # at the beginning of the step, m
    force: tuple[Number, Number]  # forward and left, N
    torque: Number  # of the brakes on the wheels, N m


def find_contact_patches(car: CarParameters, state: CarState) -> Patch:
    """Computes the lowest point of each ellipsoid: -S up / sqrt(up . S up) from its centre, S the matrix of its squared half axes."""
    up, axle = state.normal, state.axle
    lean = dot(axle, up)
    round_, oval = car.wheel_radius**2, (car.wheel_width / 2) ** 2 - car.wheel_radius**2
    reach = jnp.sqrt(round_ + oval * lean * lean)  # from the hub down to the lowest point
    depth = reach - state.height - dot(up, state.hub)
    arm = up * (0.5 * depth - round_ / reach) - axle * (oval * lean / reach)
    rotation = Vector(0.0, 0.0, state.steer_rate) + axle * state.spin
    velocity = state.velocity + cross(state.rate, state.hub + arm) + Vector(0.0, 0.0, state.travel_rate) + cross(rotation, arm)
    along = cross(axle, up)
    forward = along * (1.0 / jnp.maximum(length(*along), 1e-3))
    return Patch(depth, arm, velocity, forward, cross(up, forward))


def compute_limits(car: CarParameters, mu: Number, load: Number, slip: tuple[Number, Number], rolling: Number) -> Limits:
    """Computes stiffness and strength of the tyres."""
    extra = load / (equations_of_motion.total_mass(car) * GRAVITY / 4) - 1.0
    stiffness = car.tyre_slip_stiffness * load * jnp.maximum(1.0 - car.tyre_stiffness_fall * extra, MIN_LOAD_FACTOR)
    peak = mu * load * jnp.maximum(1.0 - car.tyre_peak_fall * extra, MIN_LOAD_FACTOR)
    sliding = jnp.maximum(length(*slip) - peak_ratio(car.tyre_shape) * peak / jnp.maximum(stiffness, 1.0) * rolling, 0.0)
    fall = car.tyre_sliding_fraction + (1.0 - car.tyre_sliding_fraction) * jnp.exp(-sliding / car.tyre_sliding_speed)
    return Limits(stiffness / car.tyre_relaxation_length, peak, fall, car.tyre_shape)


def peak_ratio(shape: Number) -> Number:
    """Computes r at the peak of g."""
    return shape * jnp.tan(0.5 * jnp.pi / shape)


def advance_deflection(
    deflection: tuple[Number, Number], slip: tuple[Number, Number], decay: Number, limits: Limits, *, dt: float
) -> tuple[Number, Number]:  # fmt: skip
    """Computes the deflection after a step with the slip velocity `slip`: implicit, and at most that of the peak."""
    x, y = ((z + dt * u) * decay for z, u in zip(deflection, slip, strict=True))
    furthest = peak_ratio(limits.shape) * limits.peak / jnp.maximum(limits.stiffness, 1.0)
    inside = jnp.minimum(1.0, furthest / jnp.maximum(length(x, y), 1e-9))
    return x * inside, y * inside


def compute_force(deflection: tuple[Number, Number], limits: Limits) -> tuple[tuple[Number, Number], Number]:
    """Computes the force (forward, left), N, and how fast its forward part falls with forward deflection, N/m (never negative)."""
    x, y = deflection
    size = length(x, y)
    peak, c = limits.peak, limits.shape
    ratio = size * limits.stiffness / jnp.maximum(peak, 1e-6)
    angle = jnp.arctan(ratio / c)
    sticks, small = ratio < peak_ratio(c), ratio < 1e-4
    shape = jnp.where(sticks, jnp.sin(c * angle), 1.0)
    secant = limits.stiffness * limits.fall * jnp.where(small, 1.0, shape / jnp.where(small, 1.0, ratio))
    radial = jnp.where(sticks, limits.stiffness * limits.fall * jnp.cos(c * angle) / (1.0 + (ratio / c) ** 2), 0.0)
    along = jnp.where(size > 1e-9, (x / jnp.maximum(size, 1e-9)) ** 2, 1.0)
    return (-secant * x, -secant * y), radial * along + secant * (1.0 - along)


def compute_tyre_forces(
    car: CarParameters,
    state: CarState,
    patch: Patch,
    tyres: Tyres,
    mu: Float[Array, "4"],
    drive_torque: Float[Array, "4"],
    brake_torque: Float[Array, "4"],
    *,
    abs_enabled: bool,
    physics_dt: float,
) -> TyreForces:
    """Computes forces of the tyres and torques of the brakes on the wheels, implicit in the deflections and the wheels' spins.

    The mass at a wheel's rim is 20 kg, that of the car 2,000 kg: a tyre's spring moves the rim by more than its deflection in a step of
    1/120 s, but not the car. So a wheel's spin acceleration a is the unknown, and the car's velocity is that of the beginning.

        inertia a = drive + brake + lever F(a)        |brake| <= brake_torque

    F falls with a, so there is one solution. A brake that can stop the wheel in this step does; otherwise its torque is full, and Newton's
    method inside a bracket finds a. An anti-lock controller limits the torque to that with which the wheel's slip ends at `abs_slip`: an
    ideal one, which knows the wheel's balance of torques. Rolling resistance is not limited.
    """
    dt = physics_dt
    pressed = patch.depth > 0.0
    slip = (dot(patch.forward, patch.velocity), dot(patch.left, patch.velocity))
    lever = dot(state.axle, cross(patch.arm, patch.forward))  # of the forward force about the axle, and of the spin on the slip
    rolling = jnp.abs(lever * state.spin)
    load = jnp.where(pressed, tyres.normal, 0.0)
    limits = compute_limits(car, mu, load, slip, rolling)
    decay = 1.0 / (1.0 + dt * rolling / car.tyre_relaxation_length)
    x, y = advance_deflection((tyres.forward, tyres.left), slip, decay, limits, dt=dt)
    x, y = jnp.where(pressed, x, 0.0), jnp.where(pressed, y, 0.0)
    inertia = car.wheel_inertia[0]

    def respond(acceleration: Number) -> tuple[tuple[Number, Number], Number]:
        ahead = (x + dt * (slip[0] + lever * dt * acceleration)) * decay
        force, fall = compute_force((ahead, (y + dt * slip[1]) * decay), limits)
        return force, fall * decay * dt * dt

    def find_torque(acceleration: Number) -> Number:
        return inertia * acceleration - drive_torque - lever * respond(acceleration)[0][0]

    if abs_enabled:
        speed = slip[0] - lever * state.spin  # of the wheel's centre
        turned = -speed / lever  # spin of a wheel that rolls freely
        torque = find_torque(((1.0 - car.abs_slip) * turned - state.spin) / dt)
        limited = jnp.clip(-jnp.sign(turned) * torque, car.rolling_torque, brake_torque)
        brake_torque = jnp.where(pressed & (jnp.abs(speed) > car.abs_speed), limited, brake_torque)
    stop = -state.spin / dt
    needed = find_torque(stop)
    holds = jnp.abs(needed) <= brake_torque
    brake = jnp.clip(needed, -brake_torque, brake_torque)
    rest = drive_torque + brake
    low, high = ((rest + sign * limits.peak * jnp.abs(lever)) / inertia for sign in (-1.0, 1.0))
    a = jnp.clip(stop, low, high)
    for _ in range(NEWTON_STEPS):
        force, fall = respond(a)
        error = inertia * a - rest - lever * force[0]
        low, high = jnp.where(error < 0.0, a, low), jnp.where(error < 0.0, high, a)
        newton = a - error / (inertia + lever**2 * fall)
        a = jnp.where((newton >= low) & (newton <= high), newton, 0.5 * (low + high))
    force, _ = respond(jnp.where(holds, stop, a))
    return TyreForces((x, y), force, brake)


def compute_generalized_forces(state: CarState, patch: Patch, tyre: TyreForces, drive_torque: Number) -> Forces:
    """Computes the generalised forces of tyres, engine and brakes on the car."""
    force = patch.forward * tyre.force[0] + patch.left * tyre.force[1]
    lever = cross(patch.arm, force)
    return Forces(
        force=sum_vectors(force),
        torque=sum_vectors(cross(state.hub + patch.arm, force)),
        suspension=force.z,
        spin=dot(state.axle, lever) + drive_torque + tyre.torque,
        steer=FRONT * lever.z,
    )


def make_normal_rows(constants: CarConstants, state: CarState, patch: Patch, *, physics_dt: float) -> NormalRows:
    """Computes the constraint rows of the normal forces."""
    car = constants.car
    impedance = jnp.clip(car.tyre_impedance, *IMPEDANCE_RANGE)
    constant = jnp.maximum(car.tyre_time_constant, 2 * physics_dt)  # MuJoCo's `refsafe`
    up = state.normal
    lever = cross(patch.arm, up)
    jacobian = [*up, *cross(state.hub + patch.arm, up), up.z, dot(state.axle, lever), FRONT * lever.z]
    reference = patch.depth / (impedance * constant**2) - 2.0 / (impedance * constant) * dot(up, patch.velocity)
    regularization = constants.wheel_weight * (1.0 - impedance) / impedance
    weight = jnp.where(patch.depth > 0.0, 1.0, 0.0) / jnp.maximum(regularization, MIN_REGULARIZATION)
    return NormalRows(jacobian, reference, weight)


def compute_outputs(patch: Patch, tyre: TyreForces, normal: Number, mu: Number) -> Tyres:
    """Computes the state and outputs after a step."""
    slip = length(dot(patch.forward, patch.velocity), dot(patch.left, patch.velocity))
    x, y = tyre.deflection
    return Tyres(x, y, normal, mu, length(*tyre.force), jnp.where(patch.depth > 0.0, slip, 0.0))
