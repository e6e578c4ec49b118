"""Films and film strips of recorded episodes, drawn without a display.

A frame shows the robot on its tile, seen from behind and from the right, with its commands beside
it and a gait diagram of the last seconds below it. MP4 needs PyAV, the extra ``video``.
"""

import contextlib
import functools
import tempfile
from collections.abc import Callable, Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import font_manager
from PIL import Image, ImageDraw, ImageFont
from tqdm import tqdm

from tdgc.benchmark.recording import Recording, runs_of_equal, spans
from tdgc.config import PhysicsConfig, RobotConfig
from tdgc.errors import InputError, require
from tdgc.files import atomic
from tdgc.parallel.jobs import run_jobs
from tdgc.show.plots import DESIRED, GAIT_COLOURS, MEASURED, POLICY_COLOURS, sheet
from tdgc.sim.commands import CONTINUOUS, UNITS, gait_index
from tdgc.sim.gaits import FEET, GAITS
from tdgc.sim.robot import Array
from tdgc.sim.stage import Stage
from tdgc.sim.tile import TILE_SIZE, Tile, TileField
from tdgc.tasks.rules import GOAL_RADIUS

FRAME_SECONDS = 0.04  # 25 frames per second: every second control step
ENDING_SECONDS = 1.0  # the last frame is held, so that the outcome can be read
GIF_EVERY, GIF_SCALE = 2, 2  # a GIF has every second frame at half size: a tenth of the bytes

# In pixels. Sizes are even because the encoder halves the resolution of the colours.
_SCENE, _PANEL, _DIAGRAM = (660, 420), 300, 120
SIZE = (_SCENE[0] + _PANEL, _SCENE[1] + _DIAGRAM)  # (width, height) of a frame
_SHOT = (400, 260)  # one picture of a strip
_MOMENTS = 5  # pictures per episode in a strip
_DIAGRAM_SECONDS = 3.0  # 6 to 12 gait cycles

# The camera, relative to the tile's x axis (start to goal); it is higher than any pillar.
_AZIMUTH, _ELEVATION, _DISTANCE = -2.45, 0.5, 1.8  # rad, rad, m
_STRIP_DISTANCE = 2.4  # m: a strip's still pictures show more of the tile
_SMOOTHING = 1.0  # s, averaging window of the camera's path

_TEXTURE = 1024  # pixels along a tile: 8 mm each
_GRID = 0.5  # m between the lines on the ground
_GROUND, _GOAL = (222, 213, 196), (0, 140, 90)
_INK, _GREY, _PALE = (30, 34, 40), (125, 130, 138), (226, 228, 232)

_MEASURED = ("vx", "vy", "yaw_rate", "body_height")  # commands whose actual values are recorded


# ---------------------------------------------------------------------------- the stage


def _font(size: int, bold: bool = False) -> ImageFont.FreeTypeFont:
    """Load DejaVu Sans, which ships with matplotlib."""
    weight = "bold" if bold else "normal"
    name = font_manager.FontProperties(family="DejaVu Sans", weight=weight)
    return ImageFont.truetype(font_manager.findfont(name), size)


def ground_picture(tile: Tile, way: Array | None = None, colour: str = "black") -> Image.Image:
    """Draw the ground's texture: height as brightness, a grid, the goal, and ``way`` (n, 2) m.

    The layout is that of ``Stage.paint``: rows along y, columns against x.
    """
    index = np.rint((np.arange(_TEXTURE) + 0.5) / _TEXTURE * (len(tile.heights) - 1)).astype(int)
    heights = tile.heights[np.ix_(index, index)].astype(np.float64)
    low, high = float(heights.min()), float(heights.max())
    # The scale spans at least 0.3 m, or low relief would look as deep as a trench.
    light = 1.0 - 0.35 * (high - heights) / max(high - low, 0.3)
    pixels = (light[..., None] * np.array(_GROUND)).astype(np.uint8)
    image = Image.fromarray(np.ascontiguousarray(pixels[::-1].transpose(1, 0, 2)))
    draw, scale = ImageDraw.Draw(image), _TEXTURE / TILE_SIZE

    def place(x: float, y: float) -> tuple[float, float]:
        return _TEXTURE - 1 - scale * x, scale * y

    for k in range(1, round(TILE_SIZE / _GRID)):
        at = k * _GRID
        draw.line([place(at, 0.0), place(at, TILE_SIZE)], (172, 165, 152), 2)
        draw.line([place(0.0, at), place(TILE_SIZE, at)], (172, 165, 152), 2)
    x, y = tile.goal
    corners = place(x + GOAL_RADIUS, y - GOAL_RADIUS), place(x - GOAL_RADIUS, y + GOAL_RADIUS)
    draw.ellipse([*corners[0], *corners[1]], (182, 222, 196), _GOAL, 6)
    if way is not None:
        draw.line([place(*point) for point in way.tolist()], colour, 5, joint="curve")
    return image


def set_stage(
    tile: Tile,
    robot: RobotConfig,
    window: bool = False,
    way: Array | None = None,
    colour: str = "black",
) -> Stage:
    """Put a robot on ``tile``, with painted ground (``ground_picture``) and a pole at the goal.

    Raises:
        WindowError: ``window`` without a display.
    """
    stage = Stage(robot, PhysicsConfig(), TileField.of(tile), window)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "ground.png")
        ground_picture(tile, way, colour).save(path)
        stage.paint(path)
    foot = np.append(tile.goal, stage.ground_height(tile.goal[:1], tile.goal[1:])[0])
    stage.mark(foot, (_GOAL[0] / 255, _GOAL[1] / 255, _GOAL[2] / 255))
    return stage


def staged(recording: Recording, trail: bool = False) -> contextlib.closing[Stage]:
    """The stage of ``recording``, to be used in a ``with`` statement, which closes it; ``trail``
    paints the base's path on the ground."""
    way = recording.position[:, :2] if trail else None
    colour = POLICY_COLOURS[recording.policy]
    stage = set_stage(recording.tile(), recording.robot, way=way, colour=colour)
    return contextlib.closing(stage)


def camera_way(recording: Recording) -> Array:
    """Points that the camera looks at, (n, 3) m: the base's path, averaged over a second."""
    half = max(1, round(0.5 * _SMOOTHING / recording.dt))
    padded = np.pad(recording.position, ((half, half), (0, 0)), mode="edge")
    sums = np.cumsum(np.pad(padded, ((1, 0), (0, 0))), axis=0)
    return (sums[2 * half + 1 :] - sums[: -2 * half - 1]) / (2 * half + 1)


def _shoot(
    stage: Stage, recording: Recording, way: Array, i: int, size: tuple[int, int], distance: float
) -> Image.Image:
    stage.show(recording.position[i], recording.quaternion[i], recording.q[i])
    return Image.fromarray(stage.picture(0, *size, _AZIMUTH, _ELEVATION, distance, target=way[i]))


# ---------------------------------------------------------------------------- a frame


class Overlay:
    """Draws what surrounds the picture: commands, gait and contacts."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self._gait = gait_index(recording.command)
        self._small, self._text, self._head = _font(11), _font(13), _font(20, bold=True)
        height = recording.height - recording.robot.base_height  # as in the command
        self._measured = dict(zip(_MEASURED, [*recording.velocity.T, height], strict=True))

    def frame(self, picture: Image.Image, i: int, ended: bool = False) -> Image.Image:
        """Compose the frame of control step ``i``, of ``SIZE``; ``ended`` adds the outcome."""
        image = Image.new("RGB", SIZE, "white")
        image.paste(picture, (0, 0))
        draw = ImageDraw.Draw(image)
        self._commands(draw, i)
        self._contacts(draw, i)
        if ended:
            text = self._recording.ending
            width = draw.textlength(text, self._head)
            draw.rectangle([16, 14, 16 + width + 20, 46], "white", _INK)
            draw.text((26, 30), text, _INK, self._head, "lm")
        return image

    def _commands(self, draw: ImageDraw.ImageDraw, i: int) -> None:
        """Draw the right-hand panel: each command within its range, and its measured value."""
        r, x0, x1 = self._recording, _SCENE[0] + 14, SIZE[0] - 14
        draw.text((x0, 12), r.policy, POLICY_COLOURS[r.policy], self._head)
        draw.text((x1, 16), f"{(i + 1) * r.dt:.2f} s", _INK, self._text, "ra")
        draw.text((x0, 40), r.where, _INK, self._small)
        gait = int(self._gait[i])
        draw.rounded_rectangle([x0, 60, x0 + 74, 80], 6, GAIT_COLOURS[gait])
        draw.text((x0 + 37, 70), GAITS[gait], "black", self._text, "mm")
        draw.rectangle([x0 + 92, 64, x0 + 96, 76], _INK)
        draw.text((x0 + 102, 70), "commanded", _INK, self._small, "lm")
        draw.ellipse([x0 + 186, 65, x0 + 196, 75], "white", MEASURED, 2)
        draw.text((x0 + 202, 70), "measured", _INK, self._small, "lm")
        for j, name in enumerate(CONTINUOUS):
            top = 92 + 27 * j
            low, high = r.bounds[j]
            value, unit = r.command[i, j], "" if UNITS[j] == "1" else UNITS[j]
            digits = 2 if high - low > 0.01 else 4
            draw.text((x0, top), name, _INK, self._small)
            shown = round(float(value), digits) + 0.0  # no -0.00
            draw.text((x1, top), f"{shown:.{digits}f} {unit}".strip(), _INK, self._small, "ra")
            line = top + 19
            draw.line([x0, line, x1, line], _PALE, 4)

            def at(v: float, low: float = low, high: float = high) -> float:
                share = (v - low) / (high - low) if high > low else 0.5
                return x0 + (x1 - x0) * min(1.0, max(0.0, share))

            if low < 0.0 < high:
                draw.line([at(0.0), line - 3, at(0.0), line + 3], _GREY, 1)
            if name in self._measured:
                x = at(float(self._measured[name][i]))
                draw.ellipse([x - 5, line - 5, x + 5, line + 5], "white", MEASURED, 2)
            draw.rectangle([at(value) - 2, line - 6, at(value) + 2, line + 6], _INK)

    def _contacts(self, draw: ImageDraw.ImageDraw, i: int) -> None:
        """Draw the gait diagram of the last seconds; its right edge is the present."""
        r, left, right, top = self._recording, 44, SIZE[0] - 14, _SCENE[1] + 8
        n = round(_DIAGRAM_SECONDS / r.dt)
        first = i + 1 - n  # control step of the window; negative before the start
        scale = (right - left) / n
        seen = slice(max(0, first), i + 1)
        begin = left + scale * (seen.start - first)
        for a, b, gait in runs_of_equal(self._gait[seen]):
            draw.rectangle([begin + scale * a, top, begin + scale * b, top + 6], GAIT_COLOURS[gait])
        for foot, name in enumerate(FEET):
            y = top + 12 + 20 * foot
            draw.text((14, y + 8), name, _INK, self._text, "lm")
            draw.rectangle([left, y, right, y + 16], (246, 247, 249))
            for a, b in spans(r.desired[seen, foot]):
                draw.rectangle([begin + scale * a, y, begin + scale * b - 1, y + 16], DESIRED)
            for a, b in spans(r.contact[seen, foot]):
                draw.rectangle([begin + scale * a, y + 5, begin + scale * b - 1, y + 11], _INK)
        y = top + 12 + 20 * len(FEET) + 8
        draw.rectangle([left, y - 5, left + 22, y + 5], DESIRED)
        draw.text((left + 28, y), "contact as the gait desires", _INK, self._small, "lm")
        draw.rectangle([left + 210, y - 3, left + 232, y + 3], _INK)
        draw.text((left + 238, y), "foot in contact", _INK, self._small, "lm")
        draw.text((right, y), f"last {_DIAGRAM_SECONDS:g} s", _INK, self._small, "rm")


def frames(recording: Recording) -> Iterator[Image.Image]:
    """The film's frames, ``FRAME_SECONDS`` apart; the last one is held for ``ENDING_SECONDS``."""
    n, every = len(recording.command), _frame_steps(recording)
    way, overlay = camera_way(recording), Overlay(recording)
    with staged(recording) as stage:
        for i in [*range(0, n - 1, every), n - 1]:
            picture = _shoot(stage, recording, way, i, _SCENE, _DISTANCE)
            yield overlay.frame(picture, i)
    last = overlay.frame(picture, n - 1, ended=True)
    for _ in range(round(ENDING_SECONDS / FRAME_SECONDS)):
        yield last


def _frame_steps(recording: Recording) -> int:
    """Control steps between two frames."""
    return max(1, round(FRAME_SECONDS / recording.dt))


# ---------------------------------------------------------------------------- files


@contextlib.contextmanager
def _mp4(path: Path, rate: Fraction) -> Iterator[Callable[[Image.Image], None]]:
    """Write an MP4 file, which appears once it is complete; yields a function that adds a frame."""
    require("MP4", ("av",), "video")
    import av

    with atomic(path) as partial, av.open(str(partial), "w", format="mp4") as file:
        stream: Any = file.add_stream("libx264", rate=rate, options={"crf": "23"})
        stream.width, stream.height = SIZE
        stream.pix_fmt = "yuv420p"  # which browsers and players support

        def add(image: Image.Image) -> None:
            frame = av.VideoFrame.from_ndarray(np.asarray(image), format="rgb24")
            file.mux(stream.encode(frame))

        yield add
        file.mux(stream.encode())


def film(recording: Recording, folder: Path, mp4: bool = True) -> None:
    """Write ``film_<name>.gif`` and, with ``mp4``, ``film_<name>.mp4``, each atomically.

    Raises:
        InputError: ``mp4`` without PyAV.
        OSError: a file cannot be written.
    """
    name = f"film_{recording.name}"  # may contain dots
    rate = 1 / Fraction(recording.dt * _frame_steps(recording)).limit_denominator(1000)
    small: list[Image.Image] = []
    with _mp4(folder / f"{name}.mp4", rate) if mp4 else contextlib.nullcontext() as add:
        for k, frame in enumerate(frames(recording)):
            if add is not None:
                add(frame)
            if k % GIF_EVERY == 0:
                size = (SIZE[0] // GIF_SCALE, SIZE[1] // GIF_SCALE)
                reduced = frame.resize(size, Image.Resampling.LANCZOS)
                # The one of Pillow's methods that preserves the robot's orange, in half the bytes.
                method = Image.Quantize.FASTOCTREE
                small.append(reduced.quantize(method=method, dither=Image.Dither.NONE))
    with atomic(folder / f"{name}.gif") as partial:
        small[0].save(
            partial,
            format="GIF",
            save_all=True,
            append_images=small[1:],
            duration=round(1000 * GIF_EVERY / rate),
            loop=0,
        )


def moments(recording: Recording) -> list[int]:
    """Control steps of a strip's pictures, evenly spaced from the first to the last."""
    return np.rint(np.linspace(0, len(recording.command) - 1, _MOMENTS)).astype(int).tolist()


def strip(recordings: Sequence[Recording], folder: Path) -> Path:
    """Write a film strip of one tile, with a row per policy, and return its path.

    Raises:
        ValueError: recordings of different tiles.
        OSError: the file cannot be written.
    """
    first = recordings[0]
    tiles = {(r.condition, r.family, r.level, r.episode, r.seed) for r in recordings}
    if len(tiles) > 1:
        raise ValueError(f"a strip shows one tile, not {len(tiles)}")
    left, head, gap = 112, 40, 6
    width = left + _MOMENTS * (_SHOT[0] + gap)
    image = Image.new("RGB", (width, head + len(recordings) * (_SHOT[1] + gap)), "white")
    draw = ImageDraw.Draw(image)
    draw.text((left, head // 2), first.where, _INK, _font(20, bold=True), "lm")
    draw.text((width - gap, head // 2), "line: path of the base", _INK, _font(15), "rm")
    for row, r in enumerate(recordings):
        y = head + row * (_SHOT[1] + gap)
        draw.text((8, y + 108), r.policy, POLICY_COLOURS[r.policy], _font(20, bold=True), "lm")
        for k, line in enumerate(r.ending.split(", ")):
            draw.text((8, y + 134 + 20 * k), line, _INK, _font(15), "lm")
        way, gaits = camera_way(r), gait_index(r.command)
        with staged(r, trail=True) as stage:
            for column, i in enumerate(moments(r)):
                x = left + column * (_SHOT[0] + gap)
                # Drawn at twice the size and reduced, because Bullet's renderer has jagged edges.
                large = _shoot(stage, r, way, i, (2 * _SHOT[0], 2 * _SHOT[1]), _STRIP_DISTANCE)
                image.paste(large.resize(_SHOT, Image.Resampling.LANCZOS), (x, y))
                gait = GAITS[gaits[i]]
                draw.rounded_rectangle([x + 8, y + 8, x + 72, y + 30], 6, GAIT_COLOURS[gaits[i]])
                draw.text((x + 40, y + 19), gait, "black", _font(14), "mm")
                draw.rounded_rectangle(
                    [x + _SHOT[0] - 64, y + 8, x + _SHOT[0] - 8, y + 30], 6, "white"
                )
                time = f"{(i + 1) * r.dt:.1f} s"
                draw.text((x + _SHOT[0] - 36, y + 19), time, _INK, _font(14), "mm")
    path = folder / first.strip
    with atomic(path) as partial:
        image.save(partial, format="PNG")
    return path


# ---------------------------------------------------------------------------- a whole evaluation

_Job = tuple[str, list[Recording]]


def _produce(job: _Job, folder: Path, mp4: bool) -> str | None:
    """Write a film and its sheet, or a strip; returns an error in one line, or None."""
    kind, recordings = job
    try:
        if kind == "strip":
            strip(recordings, folder)
        else:
            sheet(recordings[0], folder / f"sheet_{recordings[0].name}.png")
            film(recordings[0], folder, mp4)
    except (OSError, ValueError) as error:  # PyAV's, for an encoder that it lacks, is the latter
        return f"no {kind} of {recordings[0].name}: {error}"
    return None


def produce(recordings: Sequence[Recording], folder: Path, workers: int) -> list[str]:
    """Write films, sheets and strips into ``folder``.

    Each recording gets a film and a sheet; the first episode of each family, level and condition
    gets a strip of all policies.

    Returns:
        What could not be written, one line each.
    """
    problems = []
    try:
        require("MP4", ("av",), "video")
    except InputError as error:
        problems.append(str(error))
    jobs: list[_Job] = [("film", [r]) for r in recordings]
    cells: dict[tuple[str, str, int], list[Recording]] = {}
    for r in recordings:
        if r.episode == 0:
            cells.setdefault((r.condition, r.family, r.level), []).append(r)
    jobs += [("strip", rows) for rows in cells.values()]
    work = functools.partial(_produce, folder=folder, mp4=not problems)
    with tqdm(total=len(jobs), unit="film", dynamic_ncols=True) as bar:
        for problem in run_jobs(work, jobs, workers):
            problems += [problem] if problem else []
            bar.update()
    return problems
