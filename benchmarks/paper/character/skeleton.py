"""The joints of the character at rest, arms hanging away from the body (an A-pose).

In: nothing. Out: JOINTS, parents before their children, and where the bones are that hold the skin. Joints are not turned at rest: each one's axes are
the world's.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

Point = tuple[float, float, float]


@dataclass(frozen=True)
class Joint:
    """A place that turns what hangs on it."""

    name: str
    parent: str | None
    at: Point
    """World, at rest."""
    end: Point | None = None
    """Where its bone ends if no other joint begins there."""


MIDDLE = (
    Joint("hips", None, (0.0, 0.0, 0.0)),
    Joint("spine", "hips", (0.0, 0.0, 0.12)),
    Joint("chest", "spine", (0.0, 0.0, 0.24)),
    Joint("neck", "chest", (0.0, 0.0, 0.385)),
    Joint("head", "neck", (0.0, 0.0, 0.44), end=(0.0, 0.0, 0.7)),
)
LEFT = (
    Joint("left_shoulder", "chest", (0.04, 0.0, 0.345)),
    Joint("left_upper_arm", "left_shoulder", (0.155, 0.0, 0.335)),
    Joint("left_forearm", "left_upper_arm", (0.3, 0.0, 0.18)),
    Joint("left_hand", "left_forearm", (0.43, 0.0, 0.04), end=(0.5, 0.0, -0.035)),
    Joint("left_thigh", "hips", (0.09, 0.0, -0.06)),
    Joint("left_shin", "left_thigh", (0.13, -0.02, -0.36)),
    Joint("left_foot", "left_shin", (0.165, 0.0, -0.655), end=(0.185, -0.12, -0.71)),
)


def mirrored_name(name: str | None) -> str | None:
    """Of the joint on the other side."""
    return name if name is None else name.replace("left_", "right_")


def mirrored(point: Point) -> Point:
    return (-point[0], point[1], point[2])


def _right(joint: Joint) -> Joint:
    name = mirrored_name(joint.name)
    assert name is not None
    return Joint(name, mirrored_name(joint.parent), mirrored(joint.at), None if joint.end is None else mirrored(joint.end))


JOINTS = (*MIDDLE, *LEFT, *(_right(joint) for joint in LEFT))
INDEX = {joint.name: place for place, joint in enumerate(JOINTS)}
PARENTS = tuple(-1 if joint.parent is None else INDEX[joint.parent] for joint in JOINTS)
"""-1: nothing."""


def rest_positions() -> Float[ndarray, "joint 3"]:
    """World."""
    return np.array([joint.at for joint in JOINTS])


def bones(joint: str) -> list[tuple[Point, Point]]:
    """The lines that a joint's skin hangs on: to each of its children, and to its own end."""
    own = JOINTS[INDEX[joint]]
    ends = [child.at for child in JOINTS if child.parent == joint] + ([] if own.end is None else [own.end])
    return [(own.at, end) for end in ends]
