"""Bullet's own window: drive the low policy by hand, or watch a policy decide on a tile.

The window only displays the robot, which is simulated in a separate world. So nothing that happens
in the window affects the robot, except the sliders.
"""

import itertools
import time
from contextlib import closing, suppress

import numpy as np
from numpy.typing import NDArray

from tdgc.benchmark.drivers import Driver
from tdgc.benchmark.evaluation import Batch, Cell, run_cell, tile_of
from tdgc.policies import Policy
from tdgc.show.film import set_stage
from tdgc.sim.commands import (
    CONTINUOUS,
    INDEX,
    UNITS,
    VELOCITIES,
    CommandDecoder,
    default_command,
    gait_index,
)
from tdgc.sim.display import WindowError
from tdgc.sim.gaits import GAITS, gait_embedding
from tdgc.sim.robot import Array
from tdgc.sim.stage import Stage
from tdgc.tasks.executor import Executor
from tdgc.tasks.pairing import mdp_of
from tdgc.tasks.rules import GOING, OUTCOMES, outcome

MODES = ("drive", "watch")
_TEXT_SECONDS = 0.1  # between two texts, as long as a decision; faster ones cannot be read


def slider_command(values: Array) -> Array:
    """Convert slider values (13,) to commands (15,): the 12 continuous ones and the gait.

    Raises:
        ValueError: the gait value rounds to none of ``GAITS``.
    """
    return np.concatenate([values[:12], gait_embedding(round(float(values[12])))])


def describe(command: Array) -> str:
    """Format the gait and velocities of a command (15,) for the text above the robot."""
    parts = [GAITS[int(gait_index(command))]]
    parts += [f"{n} {command[INDEX[n]]:.2f} {UNITS[INDEX[n]]}" for n in VELOCITIES]
    return ", ".join(parts)


class _Window:
    """Keeps the stage in step with a world of one robot, in real time."""

    def __init__(self, batch: Batch, stage: Stage) -> None:
        self._loco, self._stage, self._dt = batch.loco, stage, batch.loco.physics.control_dt
        self._origin = np.append(batch.origin[0], 0.0)
        self._every = max(1, round(_TEXT_SECONDS / self._dt))
        self._due = time.perf_counter()

    def update(self, step: int, text: str) -> None:
        """Show the robot after control step ``step``, and wait until that step is due.

        Raises:
            WindowError: the window was closed.
        """
        state = self._loco.world.state
        self._stage.show(state.position[0] - self._origin, state.quaternion[0], state.q[0])
        if step % self._every == 0:
            self._stage.follow(text)
        self._due = max(self._due + self._dt, time.perf_counter())  # delays are not made up
        time.sleep(max(0.0, self._due - time.perf_counter()))


def drive(low: Policy, cell: Cell, seed: int) -> None:
    """Drive the robot with sliders for the 12 continuous commands and the gait.

    It runs until the window is closed. The robot returns to the start when it falls, collides or
    leaves its tile, and when the button is pressed.

    Args:
        low: the low policy.
        cell: one nominal episode, of which the tile matters.
        seed: of the evaluation's tiles.

    Raises:
        WindowError: the window cannot be opened.
    """
    config = mdp_of(low)
    tile = tile_of(seed, cell.family, cell.level, cell.first)
    stage, batch = set_stage(tile, config.robot, window=True), Batch(cell, config, seed)
    loco = batch.loco
    executor = Executor(loco, low)
    decoder, default = CommandDecoder(config.commands), default_command()
    for j, name in enumerate(CONTINUOUS):
        label = name if UNITS[j] == "1" else f"{name} ({UNITS[j]})"
        stage.add_slider(label, decoder.low[j], decoder.high[j], default[j])
    stage.add_slider(f"gait ({', '.join(GAITS)})", 0, len(GAITS) - 1, 0)
    stage.add_slider("back to the start", 1, 0, 0)
    window, row, start = _Window(batch, stage), np.zeros(1, dtype=int), batch.field.starts
    pressed = 0.0
    # That the window is closed is the normal end.
    with closing(stage), closing(loco.world), suppress(WindowError):
        for step in itertools.count():
            values = stage.read_sliders()
            executor.step(slider_command(values[:-1])[None])
            if values[-1] != pressed or outcome(loco.world)[0] != GOING:
                pressed = float(values[-1])
                loco.place(row, start[:, :2] + batch.origin, start[:, 2], np.zeros(1))
            window.update(step, describe(loco.command[0]))


class Monitor:
    """A ``Watcher`` that shows a batch of one robot in the window as it runs.

    Attributes:
        text: shown above the robot: the commands, and finally the outcome.
    """

    def __init__(self, stage: Stage) -> None:
        self._stage = stage
        self.text = ""

    def begin(self, batch: Batch) -> None:
        self._batch, self._window = batch, _Window(batch, self._stage)

    def step(self, step: int, live: NDArray[np.intp]) -> None:
        self.text = describe(self._batch.loco.command[0])
        if self._batch.outcome[0] != GOING:
            self.text = OUTCOMES[self._batch.outcome[0]].replace("_", " ")
        self._window.update(step, self.text)


def watch(low: Policy, driver: Driver, cell: Cell, seed: int) -> None:
    """Show one episode in real time, then its last state until the window is closed.

    Args:
        low: the low policy.
        driver: commands the low policy.
        cell: the episode; its count is 1.
        seed: of the evaluation's tiles.

    Raises:
        WindowError: the window cannot be opened.
    """
    tile = tile_of(seed, cell.family, cell.level, cell.first)
    stage = set_stage(tile, mdp_of(low).robot, window=True)
    with closing(stage), suppress(WindowError):  # as in ``drive``
        monitor = Monitor(stage)
        run_cell(cell, low, driver, seed, [monitor])
        while True:
            stage.follow(monitor.text)
            time.sleep(_TEXT_SECONDS)
