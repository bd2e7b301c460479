"""Dead leaves: generated pictures with the statistics of photographs.

Opaque shapes of power-law size that occlude each other give the edges, the scale invariance and the 1/f^2 spectrum of
natural pictures (Lee, Mumford and Huang, "Occlusion models for natural images", 2001).
"""

import math

import cv2
import numpy as np
from jaxtyping import Float32

from polarnet.runtime.compilation import compiled, inlined

COVERINGS = 5.0  # summed area of the shapes over that of the picture; exp(-5) of it stays uncovered
RADIUS_MIN_PX = (10.0, 32.0)  # range from which each picture draws the radius of its smallest leaves
RADIUS_MAX = 0.45  # largest radius over the picture's shorter side
SIDES_MAX = 8
NOISE_SIZE = 256  # pixels of the noise tile, a power of 2

HIDDEN = 1e-3  # a share of a pixel too small to see

ELLIPSE, POLYGON = 0, 1
PLAIN, GRATING, NOISE = 0, 1, 2

LEAF = np.dtype(
    [
        ("shape", "i4"),
        ("x", "f8"),  # centre
        ("y", "f8"),
        ("radius", "f8"),  # circle that holds the leaf
        ("cos", "f8"),  # direction of the leaf's own x axis
        ("sin", "f8"),
        ("minor", "f8"),  # half width along the leaf's y axis over the one along its x axis
        ("sides", "i4"),  # a polygon's sides; side k: normal_x x + normal_y y <= offset, in units of the radius
        ("normal_x", "f8", SIDES_MAX),
        ("normal_y", "f8", SIDES_MAX),
        ("offset", "f8", SIDES_MAX),
        ("hsv", "f8", 3),  # hue 0 to 1, saturation, value
        ("slope", "f8", 3),  # change of each from the centre to the rim, along the shading axis
        ("shade_cos", "f8"),
        ("shade_sin", "f8"),
        ("texture", "i4"),
        ("depth", "f8", 3),  # how much the texture adds to hue, saturation and value
        ("frequency", "f8"),  # grating: radians per pixel; noise: tile pixels per pixel
        ("phase_x", "f8"),
        ("phase_y", "f8"),
    ]
)


def dead_leaves(generator: np.random.Generator, height: int, width: int) -> Float32[np.ndarray, "height width 3"]:
    """Generate one picture, sRGB code values in [0, 1], the same for the same state of the generator."""
    leaves = _draw_leaves(generator, height, width)
    picture = np.zeros((height, width, 3), dtype=np.float32)
    uncovered = np.ones((height, width), dtype=np.float32)
    _paint(picture, uncovered, leaves, _noise_tile(generator))
    picture += uncovered[..., None] * generator.uniform(0.1, 0.9, 3).astype(np.float32)
    blur = generator.uniform(0.3, 0.8)  # sigma of a lens's blur, pixels; without it every edge is one pixel wide
    blurred = cv2.GaussianBlur(picture.astype(np.float64), (0, 0), blur)  # in float32 it depends on the processor
    return np.clip(blurred, 0, 1).astype(np.float32)


def _draw_leaves(generator: np.random.Generator, height: int, width: int) -> np.ndarray:
    """Draw the leaves of one picture in the order in which they fall; every octave of sizes covers the same area."""
    smallest = math.exp(generator.uniform(*np.log(RADIUS_MIN_PX)))
    largest = max(RADIUS_MAX * min(height, width), 2 * smallest)
    mean_square = 2 * math.log(largest / smallest) / (smallest**-2 - largest**-2)
    outside = largest / 2  # leaves that fall beside the picture reach into it
    area = (height + 2 * outside) * (width + 2 * outside)
    mean_filling = 0.6 * math.pi  # mean area of a leaf over its squared radius
    n = math.ceil(COVERINGS * area / (mean_filling * mean_square))

    leaves = np.zeros(n, dtype=LEAF)
    quantile = generator.random(n)
    leaves["radius"] = (smallest**-2 - quantile * (smallest**-2 - largest**-2)) ** -0.5  # density ~ radius^-3
    leaves["x"] = generator.uniform(-outside, width + outside, n)
    leaves["y"] = generator.uniform(-outside, height + outside, n)
    _draw_outlines(generator, leaves)
    _draw_colours(generator, leaves)
    _draw_textures(generator, leaves)
    return leaves


def _draw_outlines(generator: np.random.Generator, leaves: np.ndarray) -> None:
    """Make a third of the leaves ellipses (some round), a third convex polygons, a third rectangles, in place."""
    n = len(leaves)
    turn = generator.uniform(0, 2 * math.pi, n)
    leaves["cos"], leaves["sin"] = np.cos(turn), np.sin(turn)
    kind = generator.integers(0, 3, n)
    round_ = generator.random(n) < 0.4
    leaves["minor"] = np.where(round_, 1.0, generator.uniform(0.25, 1, n))
    leaves["shape"] = np.where(kind == 0, ELLIPSE, POLYGON)

    rectangle = kind == 2
    sides = np.where(rectangle, 4, generator.integers(3, SIDES_MAX + 1, n))
    side = np.arange(SIDES_MAX)
    direction = 2 * math.pi * side / sides[:, None] + np.where(
        rectangle[:, None], 0, generator.uniform(-0.5, 0.5, (n, SIDES_MAX)) / sides[:, None]
    )
    half_diagonal = np.hypot(1, leaves["minor"])
    of_rectangle = np.where(side % 2 == 0, 1, leaves["minor"][:, None]) / half_diagonal[:, None]
    leaves["sides"] = sides
    leaves["normal_x"], leaves["normal_y"] = np.cos(direction), np.sin(direction)
    leaves["offset"] = np.where(rectangle[:, None], of_rectangle, generator.uniform(0.5, 0.95, (n, SIDES_MAX)))


def _draw_colours(generator: np.random.Generator, leaves: np.ndarray) -> None:
    """Draw most hues near a few of the picture's own; saturation and value span nearly their whole range."""
    n = len(leaves)
    favoured = generator.random(generator.integers(2, 7))
    spread = generator.uniform(0.01, 0.06)
    hue = favoured[generator.integers(0, len(favoured), n)] + spread * generator.standard_normal(n)
    leaves["hsv"][:, 0] = np.where(generator.random(n) < 0.25, generator.random(n), hue)
    mean = generator.uniform(0.3, 0.65)
    leaves["hsv"][:, 1] = generator.beta(2.2 * mean, 2.2 * (1 - mean), n)
    mean = generator.uniform(0.35, 0.65)
    leaves["hsv"][:, 2] = 0.04 + 0.96 * generator.beta(2.5 * mean, 2.5 * (1 - mean), n)
    axis = generator.uniform(0, 2 * math.pi, n)
    leaves["shade_cos"], leaves["shade_sin"] = np.cos(axis), np.sin(axis)
    leaves["slope"] = generator.standard_normal((n, 3)) * [0.02, 0.12, 0.15]


def _draw_textures(generator: np.random.Generator, leaves: np.ndarray) -> None:
    n = len(leaves)
    leaves["texture"] = generator.choice([PLAIN, GRATING, NOISE], n, p=[0.3, 0.2, 0.5])
    period_px = np.exp(generator.uniform(math.log(4), math.log(24), n))
    magnification = np.exp(generator.uniform(math.log(0.7), math.log(6), n))
    leaves["frequency"] = np.where(leaves["texture"] == GRATING, 2 * math.pi / period_px, 1 / magnification)
    leaves["phase_x"] = generator.uniform(0, NOISE_SIZE, n)
    leaves["phase_y"] = generator.uniform(0, NOISE_SIZE, n)
    leaves["depth"] = generator.standard_normal((n, 3)) * [0.015, 0.08, 0.12]
    leaves["depth"][leaves["texture"] == PLAIN] = 0


def _noise_tile(generator: np.random.Generator) -> Float32[np.ndarray, "n n"]:
    """Periodic noise of standard deviation 1 whose power falls with frequency as 1/f^2, that of photographs."""
    frequency = np.hypot(np.fft.fftfreq(NOISE_SIZE)[:, None], np.fft.rfftfreq(NOISE_SIZE))
    frequency[0, 0] = np.inf
    tile = np.fft.irfft2(np.fft.rfft2(generator.standard_normal((NOISE_SIZE, NOISE_SIZE))) / frequency)
    return (tile / tile.std()).astype(np.float32)


@compiled
def _paint(picture, uncovered, leaves, noise):
    """Add the leaves to a black picture, from the topmost (the last) down; rims are blended over one pixel.

    `picture` is float32 [h, w, 3]; `uncovered`, float32 [h, w], is the share of each pixel that no leaf covers yet.
    """
    height, width = uncovered.shape
    for i in range(len(leaves) - 1, -1, -1):
        leaf = leaves[i]
        reach = leaf.radius + 1
        for row in range(max(0, math.ceil(leaf.y - reach)), min(height, math.floor(leaf.y + reach) + 1)):
            for column in range(max(0, math.ceil(leaf.x - reach)), min(width, math.floor(leaf.x + reach) + 1)):
                visible = uncovered[row, column]
                if visible == 0:
                    continue
                dx, dy = column - leaf.x, row - leaf.y
                cover = min(1.0, 0.5 - _outside_px(leaf, dx, dy))
                if cover <= 0:
                    continue
                hue, saturation, value = _colour(leaf, dx, dy, noise)
                for channel, offset in enumerate((5.0, 3.0, 1.0)):  # red, green and blue of a colour in HSV
                    k = (offset + 6 * hue) % 6
                    rgb = value * (1 - saturation * max(0.0, min(1.0, min(k, 4 - k))))
                    picture[row, column, channel] += visible * cover * rgb
                uncovered[row, column] = visible - visible * cover if visible * (1 - cover) > HIDDEN else 0


@inlined
def _outside_px(leaf, dx, dy):
    """Distance of a point (from the leaf's centre) beyond the rim in pixels, to first order; negative inside."""
    x = (leaf.cos * dx + leaf.sin * dy) / leaf.radius
    y = (leaf.cos * dy - leaf.sin * dx) / leaf.radius
    if leaf.shape == ELLIPSE:
        stretched = y / leaf.minor
        level = x * x + stretched * stretched
        slope = 2 * math.sqrt(x * x + stretched * stretched / (leaf.minor * leaf.minor))
        return leaf.radius * (level - 1) / max(slope, 1e-3)  # at the centre, where the slope is 0, well inside
    furthest = math.sqrt(x * x + y * y) - 1  # sharp corners end at the circle
    for k in range(leaf.sides):
        furthest = max(furthest, leaf.normal_x[k] * x + leaf.normal_y[k] * y - leaf.offset[k])
    return leaf.radius * furthest


@inlined
def _colour(leaf, dx, dy, noise):
    """Hue in turns, saturation and value of a leaf at a point: its colour, shaded along one axis, plus its texture."""
    shade = (leaf.shade_cos * dx + leaf.shade_sin * dy) / leaf.radius
    pattern = 0.0
    if leaf.texture == GRATING:
        pattern = 1.5 * math.sin(leaf.frequency * (leaf.shade_cos * dy - leaf.shade_sin * dx) + leaf.phase_x)
    elif leaf.texture == NOISE:
        pattern = _noise_at(noise, leaf.phase_x + leaf.frequency * dx, leaf.phase_y + leaf.frequency * dy)
    hue = leaf.hsv[0] + leaf.slope[0] * shade + leaf.depth[0] * pattern
    saturation = min(1.0, max(0.0, leaf.hsv[1] + leaf.slope[1] * shade + leaf.depth[1] * pattern))
    value = min(1.0, max(0.0, leaf.hsv[2] * (1 + 2 * leaf.slope[2] * shade + 2 * leaf.depth[2] * pattern)))
    return hue, saturation, value


@inlined
def _noise_at(noise, x, y):
    """Bilinear sample of the periodic tile."""
    left, top = math.floor(x), math.floor(y)
    fx, fy = x - left, y - top
    mask = NOISE_SIZE - 1
    c0, c1, r0, r1 = int(left) & mask, int(left + 1) & mask, int(top) & mask, int(top + 1) & mask
    upper = noise[r0, c0] + fx * (noise[r0, c1] - noise[r0, c0])
    lower = noise[r1, c0] + fx * (noise[r1, c1] - noise[r1, c0])
    return upper + fy * (lower - upper)
