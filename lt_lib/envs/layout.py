"""The one description of the scene (Fig. 1b), in metres. Physics, cameras and occlusion check are built from it."""

from functools import cached_property
from itertools import combinations, pairwise
from typing import Annotated, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from pydantic import (
    AfterValidator,
    Discriminator,
    Field,
    NonNegativeFloat,
    PositiveFloat,
    PositiveInt,
    Tag,
    ValidationError,
    model_validator,
)

from lt_lib.settings.base import Settings, UserError, layout_path
from lt_lib.settings.strict_yaml import read_yaml

LEFT, RIGHT = 0, 1
SIDES = ("left", "right")  # of the paper's two corridors
NO_CORRIDOR = -1
OUTER_THICKNESS = 0.1  # metres
FAR = 100.0  # metres outside of the arena, where slabs wait that a placement does not need


def _ordered(interval: tuple[float, float]) -> tuple[float, float]:
    if not interval[0] < interval[1]:
        raise ValueError(f"an interval needs low < high, got {list(interval)}")
    return interval


Interval = Annotated[tuple[float, float], AfterValidator(_ordered)]


class Rect(Settings):
    """The footprint of an upright box, metres."""

    x: Interval
    y: Interval

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        return (*self.x, *self.y)

    def contains(self, x, y):
        """Whether points (metres) lie inside the footprint; broadcasts."""
        return (self.x[0] <= x) & (x <= self.x[1]) & (self.y[0] <= y) & (y <= self.y[1])

    def distance(self, x, y):
        """Distance in metres from points to the footprint, 0 inside; broadcasts."""
        dx = np.maximum(np.maximum(self.x[0] - x, x - self.x[1]), 0.0)
        dy = np.maximum(np.maximum(self.y[0] - y, y - self.y[1]), 0.0)
        return np.hypot(dx, dy)


class Corridor(Settings):
    """The free rectangles cut out of the barrier, starting at the mouth, and the slab that can block them."""

    legs: Annotated[tuple[Rect, ...], Field(min_length=1)]
    slab: Rect

    def contains(self, x, y):
        return np.logical_or.reduce([leg.contains(x, y) for leg in self.legs])


class Corridors(Settings):
    """The paper's two."""

    left: Corridor
    right: Corridor


class Robot(Settings):
    """A disc, lengths in metres; friction is Coulomb's coefficient of its contact with walls and slab."""

    radius: PositiveFloat
    height: PositiveFloat
    friction: NonNegativeFloat = 1.0


class Camera(Settings):
    """A forward pinhole camera on the robot's axis with square frames; height in metres, field of view in degrees."""

    height: PositiveFloat
    fov: Annotated[float, Field(gt=0, lt=180)]
    pixels: PositiveInt


class Pose(Settings):
    """A position in metres and a heading in degrees from the x axis."""

    x: float
    y: float
    heading: float

    @property
    def array(self) -> np.ndarray:
        """(3,) x, y, heading: metres, metres, radians."""
        return np.array([self.x, self.y, np.deg2rad(self.heading)])


class JitteredPose(Pose):
    """A pose drawn anew in every episode, uniformly within +- jitter (metres, metres, degrees)."""

    jitter: tuple[float, float, float]

    def sample(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """n poses, (n, 3): metres, metres, radians."""
        spread = np.array([self.jitter[0], self.jitter[1], np.deg2rad(self.jitter[2])])
        return self.array + rng.uniform(-1, 1, (n, 3)) * spread


class Goal(Settings):
    x: float
    y: float
    radius: PositiveFloat


class Box(NamedTuple):
    """An upright box on the floor: footprint (x0, x1, y0, y1) and height in metres, and material."""

    bounds: tuple[float, float, float, float]
    height: float
    material: str

    @property
    def centre(self) -> tuple[float, float]:
        """Centre of the footprint (x, y), metres."""
        x0, x1, y0, y1 = self.bounds
        return (x0 + x1) / 2, (y0 + y1) / 2


class Layout(Settings):
    """The scene. `load_layout` reads one and checks its geometry."""

    name: str
    arena: Rect
    wall_height: PositiveFloat
    barrier: Interval
    corridors: Annotated[
        Annotated[Corridors, Tag("pair")]
        | Annotated[Annotated[tuple[Corridor, ...], Field(min_length=2)], Tag("several")],
        Discriminator(lambda value: "several" if isinstance(value, list | tuple) else "pair"),
    ]
    blocked: Annotated[tuple[PositiveInt, ...], Field(min_length=1)] = (1,)  # how many corridors, at a time
    slab_height: PositiveFloat
    robot: Robot
    camera: Camera
    spawn: JitteredPose
    scout: JitteredPose
    goal: Goal
    choice_points: Annotated[tuple[Pose, ...], Field(min_length=2)]
    communication_radius: PositiveFloat

    @property
    def routes(self) -> tuple[Corridor, ...]:
        pair = isinstance(self.corridors, Corridors)
        return (self.corridors.left, self.corridors.right) if pair else self.corridors

    @property
    def sides(self) -> tuple[str, ...]:
        """What the corridors are called."""
        return SIDES if len(self.routes) == len(SIDES) else tuple(str(i + 1) for i in range(len(self.routes)))

    @cached_property
    def placements(self) -> tuple[tuple[int, ...], ...]:
        """The corridors blocked under each placement of the slabs; with two corridors, placement 0 blocks the left."""
        corridors = range(len(self.routes))
        return tuple(some for number in self.blocked for some in combinations(corridors, number))

    @cached_property
    def slabs(self) -> Float[np.ndarray, "placements slabs 4"]:
        """Footprints (x0, x1, y0, y1) of equally many slabs under each placement; spare ones lie far outside."""
        most = max(map(len, self.placements))
        spare = np.array(self.slab(0).bounds) + [FAR, FAR, 0, 0]
        each = [[self.slab(side).bounds for side in some] + [spare] * (most - len(some)) for some in self.placements]
        return np.array(each)

    @cached_property
    def slab_centres(self) -> Float[np.ndarray, "placements slabs 2"]:
        """Where the slabs' middles are (x, y), as `slabs`."""
        return (self.slabs[..., ::2] + self.slabs[..., 1::2]) / 2

    @cached_property
    def blocks(self) -> Bool[np.ndarray, "placements corridors"]:
        """Whether each placement blocks each corridor."""
        return np.array([[i in blocked for i in range(len(self.routes))] for blocked in self.placements])

    @cached_property
    def walls(self) -> tuple[Box, ...]:
        """The four outer walls, and what remains of the barrier after the corridors are cut out."""
        (x0, x1), (y0, y1), t = self.arena.x, self.arena.y, OUTER_THICKNESS
        outer = [
            (x0 - t, x0, y0 - t, y1 + t),
            (x1, x1 + t, y0 - t, y1 + t),
            (x0, x1, y0 - t, y0),
            (x0, x1, y1, y1 + t),
        ]
        return (
            *(Box(b, self.wall_height, "wall") for b in outer),
            *(Box(b, self.wall_height, "barrier") for b in self._barrier_blocks()),
        )

    def _barrier_blocks(self) -> list[tuple[float, float, float, float]]:
        legs = [leg for corridor in self.routes for leg in corridor.legs]
        cuts = sorted({*self.barrier, *(x for leg in legs for x in leg.x if self.barrier[0] < x < self.barrier[1])})
        open_blocks, done = {}, []  # y interval -> x at which the block begins
        for x0, x1 in pairwise(cuts):
            solid = set(_complement([leg.y for leg in legs if leg.x[0] <= x0 and x1 <= leg.x[1]], self.arena.y))
            done += [(start, x0, *y) for y, start in open_blocks.items() if y not in solid]
            open_blocks = {y: open_blocks.get(y, x0) for y in solid}
        done += [(start, self.barrier[1], *y) for y, start in open_blocks.items()]
        return sorted(done)

    def slab(self, side: int) -> Box:
        """The hazard slab in a corridor, with two of them the left (0) or right (1)."""
        return Box(self.routes[side].slab.bounds, self.slab_height, "slab")

    def slab_distance(self, slab, x, y):
        """Distance in metres from points to the nearest slab of a placement; broadcasts."""
        each = [route.slab.distance(x, y) for route in self.routes]
        nearest = [np.minimum.reduce([each[i] for i in blocked]) for blocked in self.placements]
        return np.select([slab == i for i in range(len(nearest))], nearest)

    def corridor_at(self, x, y):
        """The corridor that each point lies in, or NO_CORRIDOR; broadcasts."""
        inside = [route.contains(x, y) for route in self.routes]
        return np.select(inside, range(len(inside)), NO_CORRIDOR)

    def free(self, x, y, clearance: float = 0.0):
        """Whether a disc of radius `clearance` (metres) centred on the points touches no wall; broadcasts."""
        clear = [Rect(x=b.bounds[:2], y=b.bounds[2:]).distance(x, y) > clearance for b in self.walls]
        return self.arena.contains(x, y) & np.logical_and.reduce(clear)

    @model_validator(mode="after")
    def _sound(self):
        if not self.slab_height <= self.wall_height:
            raise ValueError(f"slab_height {self.slab_height} m must not exceed wall_height {self.wall_height} m")
        if not self.camera.height < self.wall_height:
            raise ValueError(f"camera.height {self.camera.height} m must be below wall_height {self.wall_height} m")
        if max(self.blocked) >= len(self.routes) or len(set(self.blocked)) < len(self.blocked):
            raise ValueError(
                f"blocked: expected different numbers from 1 to {len(self.routes) - 1}, so that one of "
                f"{len(self.routes)} corridors stays free, got {list(self.blocked)}"
            )
        for side, corridor in zip(self.sides, self.routes, strict=True):
            self._check_corridor(side, corridor)
        sizes = [(round(c.slab.x[1] - c.slab.x[0], 6), round(c.slab.y[1] - c.slab.y[0], 6)) for c in self.routes]
        for side, size in zip(self.sides, sizes, strict=True):
            if size != sizes[0]:  # solid bodies move between the corridors
                both = f"{sizes[0]} m {self.sides[0]}, {size} m {side}"
                raise ValueError(f"the slab must have the same size in all corridors, got {both}")
        for name in ("spawn", "scout", "goal"):
            self._check_standing(name, getattr(self, name))
        for i, point in enumerate(self.choice_points):
            self._check_standing(f"choice_points[{i}]", point)
        return self

    def _check_corridor(self, side: str, corridor: Corridor):
        width = 2 * self.robot.radius
        for i, leg in enumerate(corridor.legs):
            narrow = min(leg.x[1] - leg.x[0], leg.y[1] - leg.y[0])
            if narrow <= width:
                raise ValueError(
                    f"corridors.{side}.legs[{i}] is {narrow:.2f} m wide, narrower than the robot ({width:.2f} m); "
                    f"make it wider than {width:.2f} m"
                )

    def _check_standing(self, name: str, place):
        if not self.free(place.x, place.y, self.robot.radius):
            raise ValueError(f"{name} at ({place.x}, {place.y}) stands in a wall; move it into the free arena")


def _complement(holes, whole):
    """The parts of the interval `whole` that no interval of `holes` covers."""
    edge, solid = whole[0], []
    for low, high in sorted(holes):
        if low > edge:
            solid.append((edge, low))
        edge = max(edge, high)
    return [*solid, (edge, whole[1])] if edge < whole[1] else solid


def load_layout(name: str) -> Layout:
    """Reads params/layouts/<name>.yaml, or the YAML file at a path given instead of a name.

    Raises a one-line UserError for an unknown name or an impossible scene: a corridor narrower than the robot, a robot
    in a wall, a missing or unknown key.
    """
    path = layout_path(name)
    try:
        content = read_yaml(path)
    except UserError as error:
        raise UserError(f"layout {error}") from None
    if not isinstance(content, dict) or not all(isinstance(key, str) for key in content):
        raise UserError(f"layout {path.name}: not a YAML mapping of names to values")
    try:
        return Layout(**content)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"] if part not in ("pair", "several"))
        raise UserError(
            f"layout {path.name}: {where + ': ' if where else ''}{first['msg'].removeprefix('Value error, ')}"
        ) from error
