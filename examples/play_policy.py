"""Plays a learnt policy in plain MuJoCo: needs mujoco and numpy, but not rolloutfarm.

    python play_policy.py POLICY.npz

`farm export RUN POLICY.npz` writes the file; docs/export.md describes its contents.
"""

import json
import math
import sys

import mujoco
import numpy as np

# Pi and ln 2, each as a sum of parts, and coefficients of the functions below.
PI = tuple(
    map(float.fromhex, ("0x1.921fb54400000p+1", "0x1.0b4611a600000p-33", "0x1.3198a2e037073p-68"))
)
LN2 = tuple(map(float.fromhex, ("0x1.62e42fefa2000p-1", "0x1.9ef35793c7673p-41")))
SINE = (
    2.7314447669863995e-15,
    -7.643970296798572e-13,
    1.6058977312464087e-10,
    -2.5052107616996182e-08,
    2.7557319219163234e-06,
    -0.00019841269841254974,
    0.008333333333333316,
    -0.16666666666666666,
)
TURNS = np.array([-39.759827, 76.58117, -81.60248, 41.341682, -6.2831855], dtype=np.float32)
COTH = (-691 / 653837184000, 1 / 23950080, -1 / 604800, 1 / 15120, -1 / 360, 1 / 6, 2.0)


def cos(x: np.ndarray) -> np.ndarray:
    """Cosine for |x| < 10^6, with the same bits on every processor; numpy's differs on some."""
    k = np.floor(x * (1.0 / math.pi))
    r = (k + 0.5) * PI[0] - x + (k + 0.5) * PI[1] + (k + 0.5) * PI[2]
    r = np.where(k % 2 == 0, r, -r)
    return r + np.polyval(SINE, r * r) * (r * r) * r


def sin(x: np.ndarray) -> np.ndarray:
    """Sine for |x| < 10^6, with the same bits on every processor."""
    k = np.rint(x * (1.0 / math.pi))
    r = k * PI[0] - x + k * PI[1] + k * PI[2]
    r = np.where(k % 2 == 0, -r, r)
    return r + np.polyval(SINE, r * r) * (r * r) * r


def cos_turns(x: np.ndarray) -> np.ndarray:
    """cos(2 pi x) in single precision, with the same bits on every processor."""
    s = np.abs(x - np.rint(x)) - 0.25
    return np.polyval(TURNS, s * s) * s


def exp(x: np.ndarray) -> np.ndarray:
    """e^x for |x| < 700, with the same bits on every processor."""
    k = np.rint(x * float.fromhex("0x1.71547652b82fep+0"))
    r = x - k * LN2[0] - k * LN2[1]
    return np.ldexp(1.0 + 2.0 * (r / (np.polyval(COTH, r * r) - r)), k.astype(int))


def tanh(x: np.ndarray) -> np.ndarray:
    """Hyperbolic tangent, with the same bits on every processor: (e^2|x| - 1) / (e^2|x| + 1)."""
    y = np.minimum(2.0 * np.abs(x), 40.0)
    k = np.rint(y * float.fromhex("0x1.71547652b82fep+0"))
    r = y - k * LN2[0] - k * LN2[1]
    grown, whole = 2.0 * (r / (np.polyval(COTH, r * r) - r)), np.ldexp(1.0, k.astype(int))
    above = grown * whole + (whole - 1.0)
    return np.copysign(above / (above + 2.0), x)


def powers(centres: np.ndarray, x: np.ndarray, bandwidth: float) -> np.ndarray:
    """-|c - x|^2 / (2 h^2) for each row c of centres, h the bandwidth."""
    difference = np.ascontiguousarray(centres) - x
    return (difference * difference).sum(axis=-1) * (-0.5 / bandwidth**2)


class Policy:
    """The controller: joint positions and touch in, targets of the eight servos out."""

    def __init__(self, path: str) -> None:
        """Read the file, compile its scene."""
        with np.load(path, allow_pickle=False) as file:
            self.p = {
                name: file[name] if file[name].ndim else file[name].item() for name in file.files
            }
        self.model = mujoco.MjModel.from_xml_string(self.p["mjcf"])
        self.data = mujoco.MjData(self.model)
        self.sites = [self.model.site(name).id for name in self.p["tips"]]
        self.config = json.loads(self.p["policy_config"])
        self.bandwidth = self.config.get("bandwidth")
        self.theta = (
            self.p["mu"]
            if self.p["policy"] in ("rbf", "mlp", "rnn")
            else self.p["mu"].reshape(8, -1)
        )
        if "frequencies" in self.p:
            single = self.config["precision"] == "single"
            self.kind, self.cos, unit = (
                (np.float32, cos_turns, 2.0 * math.pi) if single else (np.float64, cos, 1.0)
            )
            # A row for each component of the state
            rows = np.ascontiguousarray((self.p["frequencies"] / self.bandwidth).T)
            self.rows = (rows / unit).astype(self.kind)
            self.phases = (self.p["phases"] / unit).astype(self.kind)
            maps = {
                "projected": lambda rows: np.stack([self.features(row) for row in rows]),
                "cosine": cos,
            }
            self.theta = maps.get(self.p["policy"], np.copy)(self.theta).astype(self.kind)

    def reset(self) -> None:
        """Set the moment of release: only the fingers hold the object."""
        mujoco.mj_setState(self.model, self.data, self.p["state"], self.p["state_kind"])
        self.x, self.last, self.released = (
            self.p["x"],
            self.p["start_command"],
            self.data.qpos[8:].copy(),
        )
        self.memory = self.p.get("memory")  # of a policy that has one
        self.t, self.zero = 0, np.zeros(8)
        self.behind()

    def act(self) -> np.ndarray:
        """Compute one action (8,) [rad] and set the servos' targets from it."""
        x = self.x
        if "observation_mean" in self.p:
            x = (x - self.p["observation_mean"]) / self.p["observation_deviation"]
        a = (
            self.oscillate()
            if self.p["policy"] == "cpg"
            else self.action(self.p["policy"], self.theta, x)
        )
        base = {"offset": self.p["start_command"], "absolute": 0.0, "increment": self.last}[
            self.p["action"]
        ]
        target = base + a
        target[np.isnan(target)] = 0.0
        if self.t < self.p["zero_steps"]:  # the hand holds still and finds its servos' zero
            target = self.last
        self.last = np.minimum(np.maximum(target, self.p["lower"]), self.p["upper"])
        self.data.ctrl[:] = self.last
        return a

    def action(self, policy: str, theta: np.ndarray, x: np.ndarray) -> np.ndarray:
        """The controller's action (8,) for the state x (d,)."""
        if policy == "kernel":
            return np.array([math.exp(power) for power in powers(theta, x, self.bandwidth)])
        if policy == "rbf":
            centres, weights = np.split(theta, [self.config["centres"] * len(x)])
            values = exp(powers(centres.reshape(-1, len(x)), x, self.bandwidth))
            return (weights.reshape(8, -1) * values).sum(axis=-1)
        if policy == "weighted-kernel":
            y = (x - self.p["origin"]) / self.p["spread"]
            bandwidth = self.config["width"] * np.sqrt(len(x))
            return (
                self.config["weight_scale"]
                * theta[:, -1]
                * exp(powers(theta[:, :-1], y, bandwidth))
            )
        if policy in ("linear", "constant"):  # a constant policy has no weights for x
            return (theta[:, :-1] * x[: theta.shape[1] - 1]).sum(axis=-1) + theta[:, -1]
        if policy in ("mlp", "rnn"):
            layers = self.config["layers"] if policy == "mlp" else [self.config["units"]]
            x = x if policy == "mlp" else np.concatenate([x, self.memory])
            for units in (*layers, 8):
                rows, theta = np.split(theta, [units * (len(x) + 1)])
                rows, hidden = rows.reshape(units, -1), x
                out = (np.ascontiguousarray(rows[:, :-1]) * x).sum(axis=-1) + rows[:, -1]
                x = tanh(out)
            self.memory = hidden  # the last hidden layer; an mlp does not read it
            return out
        return (theta * self.features(x)).sum(axis=-1).astype(float)

    def oscillate(self) -> np.ndarray:
        """The action (8,) of oscillators, whose phases advance."""
        frequency, amplitude, shift, offset = self.theta.T
        a = offset + amplitude * sin(2.0 * math.pi * self.memory + shift)
        turns = self.memory + frequency * self.p["control_period"]
        self.memory = turns - np.floor(turns)
        return a

    def features(self, x: np.ndarray) -> np.ndarray:
        """Random Fourier features z(x), (d,) -> (D,)."""
        angle = self.phases.copy()
        for row, value in zip(self.rows, x.astype(self.kind), strict=True):
            angle += row * value
        return self.kind(np.sqrt(2.0 / len(angle))) * self.cos(angle)

    def feel(self) -> tuple[np.ndarray, np.ndarray, bool]:
        """Taxels (3, 18) [N], centres of force (3, 3) [fingertip radii], and whether there is any
        contact.
        """
        images, any_contact = np.zeros((3, 18)), False
        contacts = self.data.sensordata.reshape(3, -1, 7)  # found, force (3), position (3)
        for finger, site in enumerate(self.sites):
            axes = self.data.site_xmat[site].reshape(3, 3)
            for found, normal, _, _, *position in contacts[finger]:
                if found > 0 and normal > 0:
                    x, y, z = away = np.array(position) - self.data.site_xpos[site]
                    x, y, z = (
                        axes[0, k] * away[0] + axes[1, k] * away[1] + axes[2, k] * away[2]
                        for k in range(3)
                    )
                    length = np.sqrt(x * x + y * y + z * z) or 1.0
                    u = self.p["taxels"]
                    cosine = x / length * u[:, 0] + y / length * u[:, 1] + z / length * u[:, 2]
                    weight = exp(self.p["kappa"] * (cosine - 1.0))
                    images[finger] += weight * (normal / weight.sum())
                    any_contact = True
        total = images.sum(axis=-1)
        share = images / np.where(total > 0, total, 1.0)[:, None]
        points = np.stack(
            [(share * self.p["taxels"][:, k]).sum(axis=-1) for k in range(3)], axis=-1
        )
        return images, points, any_contact

    def step(self) -> tuple[float, bool]:
        """Make one control step; return its reward, and whether the object is still held."""
        a = self.act()
        for _ in range(self.p["substeps"]):
            mujoco.mj_step(self.model, self.data)
        self.t += 1
        joints, (images, points, held) = self.data.qpos[:8].copy(), self.feel()
        parts = {
            "joints": joints * self.p["joints_scale"],
            "contacts": points.ravel() * self.p["contacts_scale"],
        }
        parts["tactile"] = images.ravel() * self.p["tactile_scale"]
        parts["forces"] = (images * self.p["tactile_scale"]).sum(axis=-1)
        parts["cop"] = np.concatenate([parts["contacts"], parts["forces"]])
        parts["zeroed"] = self.behind()
        self.x = np.concatenate([parts[part] for part in self.p["input"].split("+")])
        punished = np.minimum(np.abs(a), self.p["punished_to"])
        wrong = (
            images - self.p["goal_images"],
            joints - self.p["goal_joints"],
            punished,
            points - self.p["goal_points"],
        )
        terms = [
            -w * (v.ravel() * v.ravel()).sum()
            for w, v in zip(self.p["weights"], wrong, strict=True)
        ]
        moved = [self.moved()] if self.p["motion"] else []
        return float(np.sum([*terms, 0.0 if held else -self.p["drop_penalty"], *moved])), held

    def behind(self) -> np.ndarray:
        """The servos' deflections from their mean over the first steps, as forces (8,) [N]; zero
        in these steps.
        """
        behind = self.last - self.data.qpos[:8]
        if self.t < self.p["zero_steps"]:
            self.zero = self.zero + behind / self.p["zero_steps"]
            return np.zeros(8)
        return (behind - self.zero) * self.p["deflection_scale"]

    def moved(self) -> float:
        """The penalty for the object's shift and turn since its release."""
        shift, now = self.data.qpos[8:11] - self.released[:3], self.data.qpos[11:]
        distance, cosine = np.sqrt((shift * shift).sum()), np.abs((now * self.released[3:]).sum())
        squares = (distance / self.p["moved"]) ** 2 + (1.0 - cosine) / (
            1.0 - self.p["turned_cosine"]
        )
        return float(-self.p["motion"] * np.minimum(squares, self.p["most_motion"]))


def main() -> None:
    """Play the policy once and print the result."""
    if len(sys.argv) != 2:
        sys.exit("usage: python play_policy.py POLICY.npz")
    try:
        policy = Policy(sys.argv[1])
    except KeyError as error:
        sys.exit(
            f"{sys.argv[1]} is no policy of the finger gait that farm export wrote: it has no"
            f" {error}"
        )
    except (OSError, ValueError) as error:
        sys.exit(f"{sys.argv[1]} is no policy that farm export wrote: {error}")
    policy.reset()
    total, held, t = 0.0, True, 0
    while held and t < policy.p["steps"]:
        reward, held = policy.step()
        total += policy.p["gamma"] ** t * reward
        t += 1
    forces = policy.feel()[0].sum(axis=-1)
    print(
        f"{t} control steps of {policy.p['control_period']} s, the object"
        f" {'is held' if held else 'fell'}"
    )
    print(
        "forces [N]: "
        + ", ".join(f"{n} {f:.2f}" for n, f in zip(policy.p["tips"], forces, strict=True))
    )
    print(f"return {policy.p['return_scale'] * total!r}")


if __name__ == "__main__":
    main()
