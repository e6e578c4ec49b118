"""A stage in Bullet: one robot that is posed rather than simulated, for films and a window."""

import contextlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from tdgc.config import PhysicsConfig, RobotConfig
from tdgc.sim.bullet_world import BulletWorld, pybullet
from tdgc.sim.display import WindowError, check_display
from tdgc.sim.robot import Array
from tdgc.sim.tile import TileField


class Stage(BulletWorld):
    """One robot on its tile, in pictures or in Bullet's own window.

    Args:
        robot, physics, field: as in ``World``.
        window: open Bullet's window.

    Raises:
        WindowError: ``window`` without a display.
    """

    def __init__(
        self, robot: RobotConfig, physics: PhysicsConfig, field: TileField, window: bool = False
    ) -> None:
        if window:
            check_display()
        super().__init__(1, robot, physics, field, visual=True, window=window)
        self._client = self._clients[0]
        self._sliders: list[int] = []
        self._text = -1  # none yet
        if window:
            for flag in (
                pybullet.COV_ENABLE_RGB_BUFFER_PREVIEW,
                pybullet.COV_ENABLE_DEPTH_BUFFER_PREVIEW,
                pybullet.COV_ENABLE_SEGMENTATION_MARK_PREVIEW,
            ):
                self._client.configureDebugVisualizer(flag, 0)
            # The camera of the films: behind the robot, to its right and above.
            self._client.resetDebugVisualizerCamera(1.8, -50.0, -29.0, [0.0, 0.0, 0.0])

    def show(self, position: Array, quaternion: Array, q: Array) -> None:
        """Place the robot at ``position`` (3,), ``quaternion`` (4,) with joint angles ``q`` (12,).

        Raises:
            WindowError: the window was closed.
        """
        with self._in_window():
            self.reset_robots([0], position[None], quaternion[None], q[None])

    def paint(self, texture: Path) -> None:
        """Texture the tile with an image whose row index grows along y, its column index against
        x."""
        image = self._client.loadTexture(str(texture))
        self._client.changeVisualShape(
            self._client.ground, -1, textureUniqueId=image, rgbaColor=[1.0] * 4
        )

    def mark(self, foot: Array, colour: tuple[float, float, float]) -> None:
        """Add a pole with a ball on top, 0.8 m tall, that stands at ``foot`` (3,) m."""
        for kind, height, size in (
            (pybullet.GEOM_CYLINDER, 0.4, {"radius": 0.015, "length": 0.8}),
            (pybullet.GEOM_SPHERE, 0.8, {"radius": 0.06}),
        ):
            shape = self._client.createVisualShape(kind, rgbaColor=[*colour, 1.0], **size)
            self._client.createMultiBody(0.0, -1, shape, basePosition=foot + [0.0, 0.0, height])

    # ------------------------------------------------------------------ the window

    def add_slider(self, name: str, low: float, high: float, start: float) -> None:
        """Add a slider to the window or, if ``low`` is above ``high``, a button that counts its
        clicks."""
        self._sliders.append(self._client.addUserDebugParameter(name, low, high, start))

    def read_sliders(self) -> Array:
        """Values of all sliders, in the order in which they were added.

        Raises:
            WindowError: the window was closed.
        """
        with self._in_window():
            return np.array([self._client.readUserDebugParameter(i) for i in self._sliders])

    def follow(self, text: str) -> None:
        """Point the window's camera at the robot from the current distance and direction, and
        write ``text`` above the robot.

        Raises:
            WindowError: the window was closed.
        """
        position, black = self.state.position[0], [0.0, 0.0, 0.0]
        with self._in_window():
            yaw, pitch, distance = self._client.getDebugVisualizerCamera()[8:11]
            self._client.resetDebugVisualizerCamera(distance, yaw, pitch, position.tolist())
            # Bullet writes to the right of this place, so it is to the left of the robot.
            turn, away = np.radians(yaw), 0.35 * distance
            place = position + [-away * np.cos(turn), -away * np.sin(turn), 0.35]
            self._text = self._client.addUserDebugText(
                text, place.tolist(), black, 1.0, replaceItemUniqueId=self._text
            )

    @contextlib.contextmanager
    def _in_window(self) -> Iterator[None]:
        """Raise a ``WindowError`` for Bullet's errors in the block, if the window was closed."""
        try:
            yield
        except pybullet.error as error:
            if self._client.isConnected():
                raise
            raise WindowError("the window was closed") from error
