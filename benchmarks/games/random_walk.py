"""A walk through a map of Doom that chance chooses: for captures that nobody has looked at before."""

from __future__ import annotations

import numpy as np
from games.doom_map import Map

STEPS = 10
"""Waypoints after the start."""
MIN_STEPS = 7
"""A walk that ends earlier, in a corner, is none."""
LENGTHS = (70.0, 150.0)
"""Of a step where there is room, in the map's units."""
MARGIN = 50.0
"""Kept from where the way ends; also the least length of a step."""
RADIUS = 24.0
"""The player is 16 wide on each side of its middle; some room is left."""
KNEES, HEAD = 25.0, 55.0
"""Above the floor: steps of up to 24 are climbed, and a player is 56 high."""
CLIMB = 20.0
"""Greatest difference of the floors of two waypoints."""
FAR = 400.0
"""Views of farther walls are not preferred to each other."""
TRIES = 60


def random_walk(world: Map, seed: int) -> np.ndarray | None:
    """Waypoints [P, 3], x, y and the direction to look in, degrees; None where chance ends in a corner.

    From one to the next there is a free way, as far as the map's lines tell (not whether a pit is between them). The
    player turns little by little, and looks where there is something to see.
    """
    rng = np.random.default_rng(seed)
    x, y, heading = (float(value) for value in world.start.split(","))
    waypoints, look = [(x, y, heading)], heading
    for _ in range(STEPS):
        floor = world.floor(x, y)
        for _ in range(TRIES):
            toward = heading + rng.normal(0, 70)
            step = min(rng.uniform(*LENGTHS), free_way(world, x, y, floor, toward) - MARGIN)
            ahead = np.radians(toward)
            there = x + step * np.cos(ahead), y + step * np.sin(ahead)
            if step < MARGIN or abs((higher := world.floor(*there)) - floor) > CLIMB:
                continue
            looks = look + rng.normal(0, 25, 12)
            look = looks[int(np.argmax([min(free_way(world, *there, higher, each), FAR) for each in looks]))]
            (x, y), heading = there, toward
            waypoints.append((round(x), round(y), round(look)))
            break
        else:
            break
    return np.array(waypoints, float) if len(waypoints) > MIN_STEPS else None


def free_way(world: Map, x: float, y: float, floor: float, direction: float) -> float:
    """How far a player can walk straight ahead, in the map's units.

    Args:
        world: the map.
        x, y, floor: where the player stands.
        direction: degrees.
    """
    c, s = np.cos(np.radians(direction)), np.sin(np.radians(direction))
    nearest = np.inf
    for aside in np.linspace(-RADIUS, RADIUS, 5):
        for height in (KNEES, (KNEES + HEAD) / 2, HEAD):
            origin = np.array([x - aside * s, y + aside * c, floor + height])
            nearest = min(nearest, float(world.trace(origin, np.array([[c, s, -1e-4]]), walking=True)[0][0]))
    return nearest
