"""Services and topic of the emulated Go2's own controller: motion_switcher, sport, rt/sportmodestate."""

from __future__ import annotations

from surefoot.deploy.dds import services, types
from surefoot.deploy.dds.bus import SPORT_STATE_TOPIC, Bus
from surefoot.deploy.dds.low_level import Record
from surefoot.emulator.dds.own_controller import OwnController
from surefoot.emulator.plant import Plant

_SERVE_PERIOD, _STATE_PERIOD = 10_000, 20_000
"""Periods of answering requests, and of states of the controller [us]; the period of a real robot is unknown."""


class EmulatedMotionService:
    """Answers requests to a controller, and publishes its state while it is active."""

    def __init__(self, bus: Bus, controller: OwnController, plant: Plant) -> None:
        self._controller, self._plant = controller, plant
        self._states = bus.writer(SPORT_STATE_TOPIC, types.SportModeState)
        switcher = {
            services.CHECK_MODE: controller.check_mode,
            services.SELECT_MODE: controller.select_mode,
            services.RELEASE_MODE: controller.release_mode,
        }
        sport = {
            services.DAMP: controller.damp,
            services.BALANCE_STAND: controller.stand_up,
            services.STOP_MOVE: controller.stop_move,
            services.STAND_UP: controller.stand_up,
            services.STAND_DOWN: controller.stand_down,
            services.RECOVERY_STAND: controller.stand_up,
        }
        self._servers = [
            services.Server(bus, services.MOTION_SWITCHER, switcher),
            services.Server(bus, services.SPORT, sport),
        ]

    def step(self, now: int, state: Record) -> None:
        """Answer requests, and publish the controller's state if due; `state` is the robot's latest low-level state."""
        if self._controller.blocked:
            return
        if now % _SERVE_PERIOD == 0:
            for server in self._servers:
                server.serve()
        if self._controller.active and now % _STATE_PERIOD == 0:
            self._states.write_message(self._state(now, state))

    def _state(self, now: int, state: Record) -> types.SportModeState:
        """Return position and orientation of the body; the mode and values that are not simulated are 0."""
        imu, position = state["imu_state"], self._plant.capture().position.tolist()
        return types.SportModeState(
            stamp=types.TimeSpec(now // 1_000_000, now % 1_000_000 * 1000),
            error_code=0,
            imu_state=types.IMUState(
                *(imu[name].tolist() for name in ("quaternion", "gyroscope", "accelerometer", "rpy", "temperature"))
            ),
            mode=0,
            progress=0.0,
            gait_type=0,
            foot_raise_height=0.0,
            position=position,
            body_height=position[2],
            velocity=self._plant.world.engine.base()[0, 7:].tolist(),
            yaw_speed=float(imu["gyroscope"][2]),
            range_obstacle=[0.0] * 4,
            foot_force=state["foot_force"].tolist(),
            foot_position_body=[0.0] * 12,
            foot_speed_body=[0.0] * 12,
            path_point=[types.PathPoint()] * 10,
        )
