# pyright: reportAttributeAccessIssue=false
"""Drives the cars of an exported world with MuJoCo alone: `python drive.py world.xml`, or `import drive` from your own program.

MuJoCo computes the equations of motion, suspension, steering servo, normal forces of the tyres and contacts between cars. This file
computes what MuJoCo has no model of, with the numbers of the world's custom field `car`: tangential forces of the tyres, which have a
state, engine, brakes with anti-lock, bump stops and air drag. `data.ctrl` of each car is steer (rad), throttle in [-1, 1] and brake in
[0, 1]. The friction coefficient under each wheel is that of its contact pair. The equations are those of
scenefactory_jax/dynamics/articulated.
"""

import sys
import time
from types import SimpleNamespace

import mujoco
import numpy as np

PARAMETERS = (
    "mass_total", "wheel_radius", "wheel_width", "spin_inertia", "rolling_torque", "suspension_travel", "stop_stiffness", "drive_torque",
    "drive_power", "spin_limit", "reverse_spin_limit", "reverse_speed", "brake_torque_front", "brake_torque_rear", "abs_enabled",
    "abs_slip", "abs_speed", "air_drag", "tyre_slip_stiffness", "tyre_relaxation_length", "tyre_shape", "tyre_stiffness_fall",
    "tyre_peak_fall", "tyre_sliding_fraction", "tyre_sliding_speed",
)  # fmt: skip
WHEELS = ("front_left", "front_right", "rear_left", "rear_right")
FRONT, FADE, GRAVITY, NEWTON_STEPS = np.array([1.0, 1.0, 0.0, 0.0]), 0.1, 9.81, 4


def load(model: mujoco.MjModel) -> SimpleNamespace:
    """Finds the cars of a world; returns their indices in the model, their parameters, and the state of their tyres."""
    car = SimpleNamespace(**dict(zip(PARAMETERS, model.numeric("car").data, strict=True)))
    names = [name[: -len("chassis")] for name in (model.body(i).name for i in range(model.nbody)) if name.endswith("chassis")]
    each = lambda find: np.array([[find(name, wheel) for wheel in WHEELS] for name in names])  # noqa: E731
    cars = SimpleNamespace(car=car, names=names)
    cars.chassis = np.array([model.body(f"{name}chassis").id for name in names])
    cars.wheel = each(lambda name, wheel: model.body(f"{name}wheel_{wheel}").id)
    cars.tyre = each(lambda name, wheel: model.geom(f"{name}tyre_{wheel}").id)
    cars.pair = each(lambda name, wheel: model.pair(f"{name}ground_{wheel}").id)
    cars.spin = each(lambda name, wheel: model.joint(f"{name}spin_{wheel}").dofadr[0])
    cars.travel = each(lambda name, wheel: model.joint(f"{name}suspension_{wheel}").qposadr[0])
    cars.suspension = each(lambda name, wheel: model.joint(f"{name}suspension_{wheel}").dofadr[0])
    for kind in ("steer", "steer_right", "throttle", "brake"):
        setattr(cars, kind, np.array([model.actuator(f"{name}{kind}").id for name in names]))
    cars.deflection, cars.load = np.zeros((2, len(names), 4)), np.full((len(names), 4), car.mass_total * GRAVITY / 4)
    return cars


def step(model: mujoco.MjModel, data: mujoco.MjData, cars: SimpleNamespace) -> None:
    """Advances the world by one time step."""
    mujoco.mj_step1(model, data)
    data.ctrl[cars.steer_right], data.qfrc_applied[:] = data.ctrl[cars.steer], 0.0
    apply_tyres(model, data, cars)
    apply_body_forces(model, data, cars)
    mujoco.mj_step2(model, data)
    cars.load = read_loads(data, cars)


def apply_tyres(model: mujoco.MjModel, data: mujoco.MjData, cars: SimpleNamespace) -> None:
    """Computes slip, deflection and force of every tyre, and the torque of engine and brakes, implicit in the spin."""
    car, dt, up = cars.car, model.opt.timestep, np.array([0.0, 0.0, 1.0])
    hub, axle = data.xpos[cars.wheel], data.xmat[cars.wheel].reshape(*cars.wheel.shape, 3, 3)[..., 1]
    spin, brake_torque = data.qvel[cars.spin], compute_brake_torque(data, cars)
    round_, oval = car.wheel_radius**2, (car.wheel_width / 2) ** 2 - car.wheel_radius**2
    reach = np.sqrt(round_ + oval * axle[..., 2] ** 2)
    depth = reach - hub[..., 2]
    arm = (0.5 * depth - round_ / reach)[..., None] * up - (oval * axle[..., 2] / reach)[..., None] * axle
    centre = data.subtree_com[model.body_rootid[cars.wheel]]  # of the velocities in `cvel`
    velocity = data.cvel[cars.wheel][..., 3:] + np.cross(data.cvel[cars.wheel][..., :3], hub + arm - centre)
    forward = np.cross(axle, up)
    forward /= np.maximum(np.linalg.norm(forward, axis=-1, keepdims=True), 1e-3)
    left = np.cross(up, forward)
    slip = np.stack([(forward * velocity).sum(-1), (left * velocity).sum(-1)])
    lever = (axle * np.cross(arm, forward)).sum(-1)
    rolling, pressed = np.abs(lever * spin), depth > 0.0
    load = np.where(pressed, cars.load, 0.0)

    extra = load / (car.mass_total * GRAVITY / 4) - 1.0
    stiffness = car.tyre_slip_stiffness * load * np.maximum(1.0 - car.tyre_stiffness_fall * extra, 0.3)
    peak = model.pair_friction[cars.pair, 0] * load * np.maximum(1.0 - car.tyre_peak_fall * extra, 0.3)
    furthest = car.tyre_shape * np.tan(0.5 * np.pi / car.tyre_shape)
    sliding = np.maximum(np.hypot(*slip) - furthest * peak / np.maximum(stiffness, 1.0) * rolling, 0.0)
    fall = car.tyre_sliding_fraction + (1.0 - car.tyre_sliding_fraction) * np.exp(-sliding / car.tyre_sliding_speed)
    stiffness /= car.tyre_relaxation_length
    decay = 1.0 / (1.0 + dt * rolling / car.tyre_relaxation_length)
    z = (cars.deflection + dt * slip) * decay
    limit = furthest * peak / np.maximum(stiffness, 1.0)
    z = z * np.minimum(1.0, limit / np.maximum(np.hypot(*z), 1e-9)) * pressed
    cars.deflection = z

    def respond(acceleration):
        """Force at the end of the step, and how fast its forward part falls with the acceleration of the spin times the lever."""
        ahead = (z + dt * slip + dt * dt * np.stack([lever * acceleration, np.zeros_like(lever)])) * decay
        size = np.hypot(*ahead)
        ratio = size * stiffness / np.maximum(peak, 1e-6)
        angle, sticks, safe = np.arctan(ratio / car.tyre_shape), ratio < furthest, np.maximum(ratio, 1e-9)
        secant = stiffness * fall * np.where(sticks, np.where(ratio < 1e-9, 1.0, np.sin(car.tyre_shape * angle) / safe), 1.0 / safe)
        radial = np.where(sticks, stiffness * fall * np.cos(car.tyre_shape * angle) / (1.0 + (ratio / car.tyre_shape) ** 2), 0.0)
        along = np.where(size > 1e-9, (ahead[0] / np.maximum(size, 1e-9)) ** 2, 1.0)
        return -secant * ahead, (radial * along + secant * (1.0 - along)) * decay * dt * dt

    drive = compute_drive_torque(data, cars, spin)
    torque = lambda a: car.spin_inertia * a - drive - lever * respond(a)[0][0]  # noqa: E731
    speed = slip[0] - lever * spin
    if car.abs_enabled:
        turned = -speed / lever
        limited = np.clip(-np.sign(turned) * torque(((1.0 - car.abs_slip) * turned - spin) / dt), car.rolling_torque, brake_torque)
        brake_torque = np.where(pressed & (np.abs(speed) > car.abs_speed), limited, brake_torque)
    stop = -spin / dt
    needed = torque(stop)
    brake = np.clip(needed, -brake_torque, brake_torque)
    rest = drive + brake
    low, high = (rest - peak * np.abs(lever)) / car.spin_inertia, (rest + peak * np.abs(lever)) / car.spin_inertia
    a = np.clip(stop, low, high)
    for _ in range(NEWTON_STEPS):
        force, slope = respond(a)
        error = car.spin_inertia * a - rest - lever * force[0]
        low, high = np.where(error < 0.0, a, low), np.where(error < 0.0, high, a)
        newton = a - error / (car.spin_inertia + lever**2 * slope)
        a = np.where((newton >= low) & (newton <= high), newton, 0.5 * (low + high))
    force, _ = respond(np.where(np.abs(needed) <= brake_torque, stop, a))
    cars.tangent, cars.slip = np.hypot(*force), np.hypot(*slip) * pressed
    force = forward * force[0][..., None] + left * force[1][..., None]
    for place in np.ndindex(cars.wheel.shape):
        mujoco.mj_applyFT(model, data, force[place], np.zeros(3), (hub + arm)[place], cars.wheel[place], data.qfrc_applied)
    data.qfrc_applied[cars.spin] += drive + brake


def compute_drive_torque(data: mujoco.MjData, cars: SimpleNamespace, spin: np.ndarray) -> np.ndarray:
    car, throttle = cars.car, np.clip(data.ctrl[cars.throttle], -1.0, 1.0)[:, None]
    ahead = data.xmat[cars.chassis].reshape(-1, 3, 3)[:, :, 0]
    speed = (ahead * data.qvel[find_root(cars)][:, :3]).sum(-1)[:, None]
    limit = np.where(throttle < 0.0, car.reverse_spin_limit, car.spin_limit)
    fade = np.clip((limit - np.abs(spin)) / (FADE * limit), 0.0, 1.0)
    available = np.minimum(car.drive_torque, 0.5 * car.drive_power / np.maximum(np.abs(spin), 1.0))
    return np.where((throttle >= 0.0) | (speed < car.reverse_speed), throttle, 0.0) * available * fade * FRONT


def compute_brake_torque(data: mujoco.MjData, cars: SimpleNamespace) -> np.ndarray:
    car, brake = cars.car, np.clip(data.ctrl[cars.brake], 0.0, 1.0)[:, None]
    return brake * (FRONT * car.brake_torque_front + (1.0 - FRONT) * car.brake_torque_rear) + car.rolling_torque


def apply_body_forces(model: mujoco.MjModel, data: mujoco.MjData, cars: SimpleNamespace) -> None:
    """Applies bump stops and air drag."""
    travel, room = data.qpos[cars.travel], cars.car.suspension_travel
    data.qfrc_applied[cars.suspension] -= cars.car.stop_stiffness * (travel - np.clip(travel, -room, room))
    for chassis, velocity in zip(cars.chassis, data.qvel[find_root(cars)][:, :2], strict=True):
        drag = np.append(-cars.car.air_drag * np.hypot(*velocity) * velocity, 0.0)
        mujoco.mj_applyFT(model, data, drag, np.zeros(3), data.xipos[chassis], chassis, data.qfrc_applied)


def find_root(cars: SimpleNamespace) -> np.ndarray:
    return cars.spin[:, :1] - 8 + np.arange(6)  # root joint, then suspension and steering of the first wheel, then its spin


def read_loads(data: mujoco.MjData, cars: SimpleNamespace) -> np.ndarray:
    """Reads the normal force of each tyre in the last step, N."""
    load, contact = np.zeros(cars.tyre.shape), data.contact
    for geoms, address in zip(contact.geom, contact.efc_address, strict=True):
        if address >= 0:
            load[np.isin(cars.tyre, geoms)] += data.efc_force[address]
    return load


def main() -> None:
    """Opens the viewer; its sliders are the controls of the cars. `--headless SECONDS` drives at half throttle and prints the positions."""
    model = mujoco.MjModel.from_xml_path(sys.argv[1])
    data, cars = mujoco.MjData(model), load(model)
    if "--headless" in sys.argv:
        data.ctrl[cars.throttle] = 0.5
        while data.time < float(sys.argv[sys.argv.index("--headless") + 1]):
            step(model, data, cars)
        for name, chassis in zip(cars.names, cars.chassis, strict=True):
            print(name, data.xpos[chassis].round(3))
        return
    from mujoco import viewer

    with viewer.launch_passive(model, data) as window:
        while window.is_running():
            begun = time.time()
            step(model, data, cars)
            window.sync()
            time.sleep(max(0.0, model.opt.timestep - (time.time() - begun)))


if __name__ == "__main__":
    main()
