/* What the board's program needs of a microcontroller, its motors and its sensors. One file of functions implements it.
 *
 * No function waits, except hal_idle. Angles [rad], speeds [rad/s] and torques [N m] are those of the motors, in the
 * order and with the signs of robot.h. What cannot be read is NaN: the program damps the motors then. */
#ifndef HAL_H
#define HAL_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "surefoot_wire.h"

/* What a motor does. A plain drive takes the effort alone. One with a PD law of its own may take the rest instead: with
 * its own angle q and speed w, torque or duty = feedforward + kp (target - q) - kd w. */
typedef struct {
    float effort;      /* duty of a DC motor, -1 to 1, or torque [N m] of a joint actuator */
    float target;      /* rad */
    float kp, kd;      /* effort per rad, and per rad/s */
    float feedforward; /* effort */
} motor_command;

/* Start clock, serial line, sensors and motor drivers; motors are off. */
void hal_start(void);
/* Microseconds since the start; never goes back. */
uint64_t hal_time(void);
/* Wait until something may have happened: a byte, or a part of a servo step. */
void hal_idle(void);

/* Take at most `room` bytes that have arrived on the line to the host; return how many. */
size_t hal_read_line(uint8_t *bytes, size_t room);
/* Put a whole frame on its way to the host, or nothing if there is no room for it; return whether it is on its way. */
bool hal_write_line(const uint8_t *bytes, size_t size);

/* Present angles, speeds and torques; torques are those of the currents. */
void hal_read_motors(float angle[SUREFOOT_MOTORS], float speed[SUREFOOT_MOTORS], float torque[SUREFOOT_MOTORS]);
/* What each motor does until the next call. */
void hal_drive_motors(const motor_command command[SUREFOOT_MOTORS]);
/* Switch the motor drivers on. They stay on: damped motors are driven too. */
void hal_enable_motors(void);
/* Temperature of each motor [degC]. */
void hal_read_temperatures(float temperature[SUREFOOT_MOTORS]);

/* Roll, pitch and yaw [rad] of the base in the world, and its angular velocity in the base frame [rad/s]. */
void hal_read_imu(float roll_pitch_yaw[3], float angular_velocity[3]);
/* Battery voltage [V]. */
float hal_read_voltage(void);

/* What else must damp the motors, such as a drive that does not answer: a surefoot_reason, 0 if nothing, and a text. */
uint8_t hal_hazard(const char **text);
/* What asks the host to bring the robot to rest, such as a remote control: likewise. */
uint8_t hal_sit(const char **text);

/* Start a watchdog that resets the microcontroller when it is not fed for so long. */
void hal_start_watchdog(uint32_t microseconds);
void hal_feed_watchdog(void);

#endif
