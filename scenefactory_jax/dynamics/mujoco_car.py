# pyright: reportAttributeAccessIssue=false
"""Drives the cars of an exported world with MuJoCo and numpy alone.

    python drive.py world.xml --drive 0.1 0.5 0 5     steer (rad), throttle, brake of all cars, seconds; prints where the cars are then
    python drive.py world.xml --viewer                MuJoCo's viewer; its sliders are the controls

Or `import drive`: `open_world` reads a world, `data.ctrl[cars.controls]` has a row per car (throttle -1 to 1, below zero in reverse gear;
brake 0 to 1), `step` advances it. This file computes tyres, whose deflection is in `data.userdata`, engine, brakes with anti-lock, steering
servo, bump stops and drag: the equations of scenefactory_jax/dynamics/articulated, with the world's custom fields, one number per car.
MuJoCo computes the rest. `find_cars` turns off what stands in for these forces in a plain `mj_step`.
"""

import argparse
from types import SimpleNamespace

import mujoco
import numpy as np

WHEELS = ("_front_left", "_front_right", "_rear_left", "_rear_right")
FRONT, UP, SURFACES = np.array([1.0, 1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0]), np.array([0, 0, 1, 0, 0, 0], np.uint8)  # geom groups


def open_world(path: str) -> tuple[mujoco.MjModel, mujoco.MjData, SimpleNamespace]:
    model = mujoco.MjModel.from_xml_path(path)
    data, cars = mujoco.MjData(model), find_cars(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("start").id)
    mujoco.mj_forward(model, data)  # the first step needs the loads of the tyres
    return model, data, cars


def find_cars(model: mujoco.MjModel) -> SimpleNamespace:
    """Finds indices and numbers of the cars; turns off friction of the tyres' contacts and the forces of the actuators."""
    cars = SimpleNamespace(car=SimpleNamespace(**{f.name: f.data[:, None] for f in map(model.numeric, range(model.nnumeric))}))
    cars.names = [name[: -len("chassis")] for name in (model.body(i).name for i in range(model.nbody)) if name.endswith("chassis")]

    def find(lookup, part, ends=("",), attribute="id"):
        return np.array([[np.ravel(getattr(lookup(f"{name}{part}{end}"), attribute))[0] for end in ends] for name in cars.names])

    cars.chassis, cars.controls = find(model.body, "chassis")[:, 0], find(model.actuator, "", ("steer", "throttle", "brake"))
    cars.wheel, cars.pair = find(model.body, "wheel", WHEELS), find(model.pair, "ground", WHEELS)
    cars.travel, cars.suspension = (find(model.joint, "suspension", WHEELS, address) for address in ("qposadr", "dofadr"))
    cars.angle, cars.steering = (find(model.joint, "steer", WHEELS[:2], address) for address in ("qposadr", "dofadr"))
    cars.spin, cars.root = find(model.joint, "spin", WHEELS, "dofadr"), find(model.joint, "root", attribute="dofadr") + np.arange(6)
    cars.load, cars.patches = find(model.sensor, "load", WHEELS, "adr"), any(model.geom(i).name[:5] == "patch" for i in range(model.ngeom))
    model.pair_dim[cars.pair], model.tendon_stiffness[find(model.tendon, "toe")] = 1, 0.0
    model.actuator_gainprm[cars.controls] = model.actuator_biasprm[cars.controls] = 0.0
    return cars


def step(model: mujoco.MjModel, data: mujoco.MjData, cars: SimpleNamespace) -> None:
    """Advances the world by one time step: `mj_step`, with `apply_forces` where it calls `mjcb_control`."""
    mujoco.mj_step1(model, data)
    apply_forces(model, data, cars)
    mujoco.mj_step2(model, data)


def apply_forces(model: mujoco.MjModel, data: mujoco.MjData, cars: SimpleNamespace) -> None:
    velocity, rotation, travel = data.qvel[cars.root[:, :3]], data.xmat[cars.chassis].reshape(-1, 3, 3), data.qpos[cars.travel]
    car, (steer, throttle, brake) = cars.car, np.split(np.clip(data.ctrl, *model.actuator_ctrlrange.T)[cars.controls], 3, axis=1)
    stop = car.stop_stiffness * (np.clip(travel, -car.suspension_travel, car.suspension_travel) - travel)
    servo = car.steering_stiffness * (steer - data.qpos[cars.angle]) - car.steering_damping * data.qvel[cars.steering]
    drag = -car.air_drag * np.hypot(velocity[:, :1], velocity[:, 1:2]) * velocity * (1.0 - UP)
    drag -= car.lateral_damping * (rotation[:, :, 1] * velocity).sum(-1, keepdims=True) * rotation[:, :, 1]
    torque = np.cross((data.xipos - data.xpos)[cars.chassis], drag)
    data.qfrc_applied[:], data.qfrc_applied[cars.suspension], data.qfrc_applied[cars.root[:, :3]] = 0.0, stop, drag
    data.qfrc_applied[cars.steering] = np.clip(servo, -car.steering_torque, car.steering_torque)
    data.qfrc_applied[cars.root[:, 3:]] = np.einsum("nij,ni->nj", rotation, torque) - car.yaw_damping * UP * data.qvel[cars.root[:, 3:]]
    speed, spin = (rotation[:, :, 0] * velocity).sum(-1, keepdims=True), np.abs(data.qvel[cars.spin])
    fade = np.clip((1.0 - spin / np.where(throttle < 0.0, car.reverse_spin_limit, car.spin_limit)) / car.drive_fade_fraction, 0.0, 1.0)
    engine = FRONT * fade * np.minimum(car.drive_torque, 0.5 * car.drive_power / np.maximum(spin, 1.0))
    drive = np.where((throttle >= 0.0) | (speed < car.reverse_speed), throttle, 0.0) * engine
    apply_tyres(model, data, cars, drive, brake * np.where(FRONT, car.brake_torque_front, car.brake_torque_rear) + car.rolling_torque)


def apply_tyres(model: mujoco.MjModel, data: mujoco.MjData, cars: SimpleNamespace, drive: np.ndarray, brake_torque: np.ndarray) -> None:
    """Computes slip, deflection and force of every tyre and the torque of the brakes, implicit in the deflection and the wheel's spin."""
    car, dt, shape = cars.car, model.opt.timestep, cars.wheel.shape
    hub, axle, spin = data.xpos[cars.wheel], data.xmat[cars.wheel].reshape(*shape, 3, 3)[..., 1], data.qvel[cars.spin]
    round_, oval = car.wheel_radius**2, (car.wheel_width / 2) ** 2 - car.wheel_radius**2
    reach = np.sqrt(round_ + oval * axle[..., 2] ** 2)  # of the ellipsoid, down from the hub
    depth = reach - hub[..., 2]
    arm = (0.5 * depth - round_ / reach)[..., None] * UP - (oval * axle[..., 2] / reach)[..., None] * axle
    twist, place = data.cvel[cars.wheel], hub + arm  # `cvel` is that of the car's centre of mass
    velocity = twist[..., 3:] + np.cross(twist[..., :3], place - data.subtree_com[model.body_rootid[cars.wheel]])
    forward = np.cross(axle, UP) / np.maximum(np.hypot(axle[..., 0], axle[..., 1]), 1e-3)[..., None]
    left, lever = np.cross(UP, forward), (axle * np.cross(arm, forward)).sum(-1)
    slip = np.stack([(forward * velocity).sum(-1), (left * velocity).sum(-1)])
    rolling, pressed, found = np.abs(lever * spin), depth > 0.0, np.zeros(1, np.int32)  # found: the surface under a wheel
    for wheel in np.ndindex(shape) if cars.patches and round(data.time / dt) % car.friction_substeps.max() == 0 else ():
        if mujoco.mj_ray(model, data, hub[wheel], -UP, SURFACES, True, -1, found) >= 0.0:
            model.pair_friction[cars.pair[wheel], :2] = model.geom_friction[found[0], 0]
    load = data.sensordata[cars.load] * pressed
    extra = load / car.nominal_load - 1.0
    stiffness = car.tyre_slip_stiffness * load * np.maximum(1.0 - car.tyre_stiffness_fall * extra, car.min_load_factor)
    peak = model.pair_friction[cars.pair, 0] * load * np.maximum(1.0 - car.tyre_peak_fall * extra, car.min_load_factor)
    furthest = car.tyre_shape * np.tan(0.5 * np.pi / car.tyre_shape)
    sliding = np.maximum(np.hypot(*slip) - furthest * peak / np.maximum(stiffness, 1.0) * rolling, 0.0)
    fall = car.tyre_sliding_fraction + (1.0 - car.tyre_sliding_fraction) * np.exp(-sliding / car.tyre_sliding_speed)
    stiffness = stiffness / car.tyre_relaxation_length
    decay = 1.0 / (1.0 + dt * rolling / car.tyre_relaxation_length)
    state = data.userdata[: 2 * spin.size].reshape(2, *shape)  # deflection, forward and left
    z = (state + dt * slip) * decay
    state[:] = z = z * np.minimum(1.0, furthest * peak / np.maximum(stiffness, 1.0) / np.maximum(np.hypot(*z), 1e-9)) * pressed

    def respond(a):  # spin acceleration -> forces at the end of the step, slope of the forward one, torque missing on the wheel
        ahead = (z + dt * slip + dt * dt * np.stack([lever * a, np.zeros(shape)])) * decay
        size = np.maximum(np.hypot(*ahead), 1e-9)
        ratio = np.maximum(size * stiffness / np.maximum(peak, 1e-6), 1e-9)
        angle, sticks, along = np.arctan(ratio / car.tyre_shape), ratio < furthest, (ahead[0] / size) ** 2
        secant = stiffness * fall * np.where(sticks, np.sin(car.tyre_shape * angle), 1.0) / ratio
        radial = np.where(sticks, stiffness * fall * np.cos(car.tyre_shape * angle) / (1.0 + (ratio / car.tyre_shape) ** 2), 0.0)
        slope = (radial * along + secant * (1.0 - along)) * decay * dt * dt
        return -secant * ahead, slope, car.spin_inertia * a - drive + lever * secant * ahead[0]

    turned, stop = spin - slip[0] / lever, -spin / dt  # spin of a wheel that rolls freely, acceleration to rest
    limited = np.clip(-np.sign(turned) * respond(((1.0 - car.abs_slip) * turned - spin) / dt)[2], car.rolling_torque, brake_torque)
    brake_torque = np.where(pressed & (np.abs(lever * turned) > car.abs_speed) & (car.abs_enabled > 0.0), limited, brake_torque)
    brake = np.clip(needed := respond(stop)[2], -brake_torque, brake_torque)
    low, high = ((drive + brake + sign * peak * np.abs(lever)) / car.spin_inertia for sign in (-1.0, 1.0))
    a = np.clip(stop, low, high)
    for _ in range(int(car.newton_steps.max())):  # in a bracket
        _, slope, missing = respond(a)
        low, high = np.where(missing < brake, a, low), np.where(missing < brake, high, a)
        newton = a - (missing - brake) / (car.spin_inertia + lever**2 * slope)
        a = np.where((newton >= low) & (newton <= high), newton, 0.5 * (low + high))
    force = respond(np.where(np.abs(needed) <= brake_torque, stop, a))[0]
    cars.tangent, cars.slip = np.hypot(*force), np.hypot(*slip) * pressed
    force = forward * force[0][..., None] + left * force[1][..., None]
    for wheel in np.ndindex(shape):
        mujoco.mj_applyFT(model, data, force[wheel], np.zeros(3), place[wheel], cars.wheel[wheel], data.qfrc_applied)
    data.qfrc_applied[cars.spin] += drive + brake


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("world")
    parser.add_argument("--viewer", action="store_true")
    parser.add_argument("--drive", type=float, nargs=4, default=(0, 0.5, 0, 5), metavar=("STEER", "THROTTLE", "BRAKE", "SECONDS"))
    options = parser.parse_args()
    model, data, cars = open_world(options.world)
    data.ctrl[cars.controls] = options.drive[:3]
    if options.viewer:
        from mujoco import viewer

        mujoco.set_mjcb_control(lambda model, data: apply_forces(model, data, cars))
        viewer.launch(model, data)
    while not options.viewer and data.time < options.drive[3] - 0.5 * model.opt.timestep:
        step(model, data, cars)
    print(*(f"{name} {data.xpos[chassis].round(3)}" for name, chassis in zip(cars.names, cars.chassis, strict=True)), sep="\n")
