"""The dance: how the character's joints turn and where its hips are, at any time.

In: seconds. Out: a turn for each joint against its parent, and the hips' place. Hips sway, bounce and turn with the beat, the trunk answers, arms are
thrown up in turn, and feet step: legs are solved from the hips and from where the feet are (two bones, knees forward), so that a foot that stands does not
slide. It begins and ends in the very pose of rest, slowly.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial.transform import Rotation

from benchmarks.paper.character.skeleton import INDEX, JOINTS, PARENTS, rest_positions

DURATION = 4.0
"""[s]"""
FPS = 24
BEAT = 0.5
"""[s]"""
GATHER = 0.5
"""How long it takes from rest into the dance, and out of it [s]."""
STEP_HEIGHT, SWAY, BOUNCE = 0.12, 0.045, 0.028
"""Of feet, of the hips to the side, and of the hips downward [world units]."""
FORWARD = np.array([0.0, -1.0, 0.0])
"""Where knees point."""
Vector = Float[ndarray, "3"]


@dataclass(frozen=True, eq=False)
class DancePose:
    """All joints at one time."""

    turns: Rotation
    """(joint,) parent from joint; joints are not turned at rest."""
    hips: Vector
    """World."""


def dance_pose(seconds: float) -> DancePose:
    """At a time from 0 to DURATION; before and after it, at rest."""
    rest = rest_positions()
    much = _gathered(seconds)
    beat = 2 * np.pi * seconds / BEAT
    slow, half = beat / 4, beat / 2
    side = np.sin(half)
    degrees: dict[str, tuple[float, float, float]] = {
        "hips": (0, 6 * side, 16 * np.sin(slow)),
        "spine": (5 * np.sin(beat), -7 * side, -7 * np.sin(slow)),
        "chest": (4 * np.sin(beat), -5 * side, -14 * np.sin(slow)),
        "neck": (-5 * np.sin(beat), 3 * side, 6 * np.sin(slow)),
        "head": (-9 * np.sin(beat), 4 * side, 10 * np.sin(slow)),
    }
    turns = {name: Rotation.from_euler("xyz", much * np.array(angles), degrees=True) for name, angles in degrees.items()}
    for sign, name in ((1, "left"), (-1, "right")):
        # 0 hangs down, 1 is thrown up; one arm after the other.
        up = 0.5 + 0.5 * sign * np.sin(slow - 0.6)
        turns |= {f"{name}_{joint}": turn for joint, turn in _arm(sign, up, beat, much).items()}
    hips = rest[INDEX["hips"]] + much * np.array([SWAY * side, 0.01 * np.sin(slow), -BOUNCE * (1 - np.cos(beat)) / 2 - 0.012])
    for sign, name in ((1, "left"), (-1, "right")):
        lifted = max(0.0, -sign * side) ** 2
        turns |= _leg(name, turns["hips"], hips, much * lifted)
    ordered = [turns.get(joint.name, Rotation.identity()) for joint in JOINTS]
    return DancePose(Rotation.from_quat([turn.as_quat() for turn in ordered]), hips)


def world_joints(pose: DancePose) -> tuple[Float[ndarray, "joint 3"], Rotation]:
    """Where joints are, and how they are turned."""
    rest = rest_positions()
    places, turned = np.array(rest), [Rotation.identity()] * len(JOINTS)
    for joint, parent in enumerate(PARENTS):
        if parent < 0:
            places[joint], turned[joint] = pose.hips, pose.turns[joint]
            continue
        turned[joint] = turned[parent] * pose.turns[joint]
        places[joint] = places[parent] + turned[parent].apply(rest[joint] - rest[parent])
    return places, Rotation.from_quat([turn.as_quat() for turn in turned])


def _gathered(seconds: float) -> float:
    """0 at both ends, 1 in between, with a slope that nowhere jumps."""
    share = np.clip(min(seconds, DURATION - seconds) / GATHER, 0, 1)
    return float(share * share * (3 - 2 * share))


def _arm(sign: int, up: float, beat: float, much: float) -> dict[str, Rotation]:
    """Turns of the left (1) or right (-1) arm, which hangs 47 degrees below the horizontal at rest."""

    def turn(raised: float, forward: float) -> Rotation:
        # About y the left arm is raised by a negative angle, about z brought forward by a negative one; the right arm by positive ones.
        return Rotation.from_euler("yz", much * -sign * np.array([raised, forward]), degrees=True)

    return {
        "shoulder": turn(-4 + 16 * up, 0),
        "upper_arm": turn(-14 + 96 * up, 26 * (1 - up)),
        "forearm": turn(10 + 34 * up + 14 * np.sin(beat), 62 * (1 - up) + 10),
        "hand": turn(16 * np.sin(beat + 0.7), 0),
    }


def _leg(name: str, hips_turn: Rotation, hips: Vector, lifted: float) -> dict[str, Rotation]:
    """Turns of one leg whose foot stands where it stands at rest, or is lifted by a part of STEP_HEIGHT; the foot's own turn keeps its sole level."""
    rest = rest_positions()
    thigh, shin, foot = (INDEX[f"{name}_{part}"] for part in ("thigh", "shin", "foot"))
    top = hips + hips_turn.apply(rest[thigh] - rest[INDEX["hips"]])
    ankle = rest[foot] + lifted * (STEP_HEIGHT * np.array([0.0, 0.0, 1.0]) + 0.3 * STEP_HEIGHT * FORWARD)
    upper, lower = (float(np.linalg.norm(rest[b] - rest[a])) for a, b in ((thigh, shin), (shin, foot)))
    # Its knee points where the knee points at rest, turned as the hips are.
    knee = _knee(top, ankle, upper, lower, hips_turn.apply(rest[shin] - 0.5 * (rest[thigh] + rest[foot])) + 2 * lifted * FORWARD)
    thigh_turn = _frame(knee - top, ankle - top) * _frame(rest[shin] - rest[thigh], rest[foot] - rest[thigh]).inv()
    shin_turn = _frame(ankle - knee, ankle - top) * _frame(rest[foot] - rest[shin], rest[foot] - rest[thigh]).inv()
    return {
        f"{name}_thigh": hips_turn.inv() * thigh_turn,
        f"{name}_shin": thigh_turn.inv() * shin_turn,
        f"{name}_foot": shin_turn.inv() * Rotation.from_euler("x", 25 * lifted, degrees=True),
    }


def _knee(top: Vector, ankle: Vector, upper: float, lower: float, towards: Vector) -> Vector:
    """Where two bones of given lengths meet between their ends, bent `towards`; on the straight line where they do not reach."""
    line = ankle - top
    reach = min(float(np.linalg.norm(line)), upper + lower)
    along = line / np.linalg.norm(line)
    share = (upper * upper - lower * lower + reach * reach) / (2 * reach)
    across = towards - (towards @ along) * along
    return top + share * along + np.sqrt(max(upper * upper - share * share, 0.0)) * across / np.linalg.norm(across)


def _frame(along: Vector, beside: Vector) -> Rotation:
    """Axes: along, across it in the plane of both, and across both."""
    first = along / np.linalg.norm(along)
    third = np.cross(first, beside)
    third = third / np.linalg.norm(third)
    return Rotation.from_matrix(np.stack([first, np.cross(third, first), third], -1))
