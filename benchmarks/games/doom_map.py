"""A map of Doom: read from a WAD file, made static, and followed along rays."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from ssa_nerfstudio.errors import InputError

# Rows of a map's lumps (https://doomwiki.org/wiki/WAD).
THING = np.dtype([("x", "<i2"), ("y", "<i2"), ("angle", "<i2"), ("kind", "<i2"), ("flags", "<i2")])
_PLAYER = 1
_VERTEX = np.dtype(("<i2", 2))
LINE = np.dtype([("ends", "<u2", 2), ("flags", "<u2"), ("special", "<u2", 2), ("sides", "<u2", 2)])
SIDE = np.dtype([("offset", "<i2", 2), ("textures", "S8", 3), ("sector", "<u2")])
SECTOR = np.dtype([("floor", "<i2"), ("ceiling", "<i2"), ("flats", "S8", 2), ("light", "<i2"), ("special", "<i2", 2)])
_NO_SIDE = 0xFFFF
_LUMPS = 10


@dataclass(frozen=True)
class Map:
    """A map of Doom: its name and its lumps."""

    name: str
    lumps: dict[str, bytes]

    @classmethod
    def read(cls, wad: Path, name: str) -> Map:
        """Read a map from a WAD file.

        Raises:
            InputError: the file is no WAD, or has no such map.
        """
        data = wad.read_bytes() if wad.is_file() else b""
        if data[:4] not in (b"IWAD", b"PWAD"):
            raise InputError(f"{wad} is no WAD file", "name freedoom1, freedoom2, or the path of a .wad file")
        count, at = struct.unpack("<ii", data[4:12])
        entries = [struct.unpack("<ii8s", data[at + 16 * i : at + 16 * i + 16]) for i in range(count)]
        names = [raw.rstrip(b"\0").decode("latin1") for _, _, raw in entries]
        if name not in names:
            maps = [names[i - 1] for i, lump in enumerate(names) if lump == "THINGS"]
            raise InputError(f"{wad} has no map {name}", f"choose one of {', '.join(maps)}")
        first = names.index(name) + 1
        chosen = range(first, first + _LUMPS)
        return cls(name, {names[i]: data[entries[i][0] : entries[i][0] + entries[i][1]] for i in chosen})

    @property
    def start(self) -> str:
        """Where the game starts a player, as a waypoint.

        Raises:
            InputError: nowhere.
        """
        things = self._rows("THINGS", THING)
        players = things[things["kind"] == _PLAYER]
        if not len(players):
            raise InputError(f"{self.name} has no start of a player", "choose another map")
        return ",".join(str(value) for value in players[0].item()[:3])

    def static(self, start: np.ndarray) -> Map:
        """The map with the player its only thing, in which nothing moves, opens, flickers or hurts.

        Args:
            start: x, y and direction of the player.
        """
        lines, sectors = self._rows("LINEDEFS", LINE).copy(), self._rows("SECTORS", SECTOR).copy()
        lines["special"] = sectors["special"] = 0
        player = np.array((*np.rint(start).astype(int), _PLAYER, 7), THING)
        emptied = {"THINGS": player.tobytes(), "LINEDEFS": lines.tobytes(), "SECTORS": sectors.tobytes()}
        return Map(self.name, {**self.lumps, **emptied})

    def write(self, path: Path) -> None:
        """Write a WAD file that holds the map alone."""
        body, entries = b"", struct.pack("<ii8s", 0, 0, self.name.encode())
        for name, lump in self.lumps.items():
            entries += struct.pack("<ii8s", 12 + len(body), len(lump), name.encode())
            body += lump
        path.write_bytes(struct.pack("<4sii", b"PWAD", len(self.lumps) + 1, 12 + len(body)) + body + entries)

    def trace(self, origin: np.ndarray, directions: np.ndarray, walking: bool = False) -> tuple[np.ndarray, np.ndarray]:
        """Follow rays to the first wall, floor or ceiling. The game's own depth has 8 bits, this none to spare.

        Args:
            origin: [3], inside a sector.
            directions: [N, 3], not vertical.
            walking: whether rays also end at lines that let pictures through and no player.

        Returns:
            Depth [N] in multiples of the directions, and whether it is a surface [N]: not where a ray ends in the sky.
        """
        sector = self._walls[2]
        closed = self._impassable if walking else np.zeros(len(sector), bool)
        floor, ceiling, sky = (self._sectors[key] for key in ("floor", "ceiling", "sky"))
        t, turn = self._crossings(origin, directions)
        rays = np.arange(len(directions))
        with np.errstate(all="ignore"):
            depth, solid = np.full(len(rays), np.inf), np.zeros(len(rays), bool)
            for line in np.argsort(t, axis=1).T:  # those that each ray crosses, from near to far
                at = t[rays, line]
                crossed = np.isfinite(at) & np.isinf(depth)
                if not crossed.any():
                    break
                back = (turn[rays, line] > 0).astype(int)
                near, far = sector[line, back], sector[line, 1 - back]
                height = origin[2] + directions[:, 2] * at
                below, above = height < floor[near], height > ceiling[near]
                over = (far >= 0) & (height > ceiling[far])
                # Between two open skies there is no wall.
                wall = (far < 0) | closed[line] | (height < floor[far]) | (over & ~(sky[near] & sky[far]))
                ends = crossed & (below | above | over | wall)
                flat = (np.where(below, floor[near], ceiling[near]) - origin[2]) / directions[:, 2]
                depth[ends] = np.where(below | above, flat, at)[ends]
                solid[ends] = np.where(above, ~sky[near], below | wall)[ends]
        return depth, solid

    def floor(self, x: float, y: float) -> float:
        """Height of the floor at a place inside a sector."""
        # Not along an axis, as many lines are.
        t, turn = self._crossings(np.array([x, y]), np.array([[0.9238, 0.3827]]))
        line = t[0].argmin()
        return float(self._sectors["floor"][self._walls[2][line, int(turn[0, line] > 0)]])

    def _crossings(self, origin: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where rays cross lines, seen from above.

        Args:
            origin: [2 or 3].
            directions: [N, 2 or 3].

        Returns:
            Depth [N, L] in multiples of the directions, infinite where a ray misses a line; and a number [N, L] that is
            positive where the ray meets the back of the line.
        """
        start, along, _ = self._walls
        start = start - origin[:2]
        with np.errstate(all="ignore"):
            # Ray and line in the plane: t directions = start + part along.
            turn = directions[:, :1] * along[:, 1] - directions[:, 1:2] * along[:, 0]
            t = (start[:, 0] * along[:, 1] - start[:, 1] * along[:, 0]) / turn
            part = (start[:, 0] * directions[:, 1:2] - start[:, 1] * directions[:, :1]) / turn
        t[~((t > 1e-6) & (part >= 0) & (part <= 1))] = np.inf
        return t, turn

    @cached_property
    def _walls(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of each line: start [L, 2], vector to its end [L, 2], and the sectors on its sides [L, 2], -1: none."""
        lines, sides = self._rows("LINEDEFS", LINE), self._rows("SIDEDEFS", SIDE)
        ends = self._rows("VERTEXES", _VERTEX)[lines["ends"]].astype(float)
        facing = sides["sector"][np.minimum(lines["sides"], len(sides) - 1)].astype(int)
        return ends[:, 0], ends[:, 1] - ends[:, 0], np.where(lines["sides"] == _NO_SIDE, -1, facing)

    @cached_property
    def _impassable(self) -> np.ndarray:
        """Lines that no player crosses, [L]."""
        return (self._rows("LINEDEFS", LINE)["flags"] & 1).astype(bool)

    @cached_property
    def _sectors(self) -> dict[str, np.ndarray]:
        rows = self._rows("SECTORS", SECTOR)
        return {"floor": rows["floor"], "ceiling": rows["ceiling"], "sky": rows["flats"][:, 1] == b"F_SKY1"}

    def _rows(self, lump: str, row: np.dtype) -> np.ndarray:
        return np.frombuffer(self.lumps[lump], row)
