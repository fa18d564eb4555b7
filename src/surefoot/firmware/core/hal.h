/* Hardware abstraction of the board's program: microcontroller, motors and sensors.
 *
 * No function waits, except hal_idle. Angles [rad], speeds [rad/s] and torques [N m] refer to the motors, in the order
 * and with the signs of robot.h. Readings that are not available are NaN; the program then damps the motors. */
#ifndef HAL_H
#define HAL_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "surefoot_wire.h"

/* Command to a motor. A plain drive uses only the effort. A drive with its own PD control may use the other values:
 * with its angle q and speed w, torque or duty = feedforward + kp (target - q) - kd w. */
typedef struct {
    float effort;      /* duty of a DC motor, -1 to 1, or torque [N m] of a joint actuator */
    float target;      /* rad */
    float kp, kd;      /* effort per rad, and per rad/s */
    float feedforward; /* effort */
} motor_command;

/* Start clock, serial line, sensors and motor drivers, with the motors off. */
void hal_start(void);
/* Time since the start [us]; never decreases. */
uint64_t hal_time(void);
/* Wait for a byte, or for a fraction of a servo step. */
void hal_idle(void);

/* Read at most `room` bytes that have arrived from the host; return how many. */
size_t hal_read_line(uint8_t *bytes, size_t room);
/* Send a complete frame to the host, or nothing if there is no room for it; return whether it is sent. */
bool hal_write_line(const uint8_t *bytes, size_t size);

/* Present angles, speeds and torques; torques are estimated from the currents. */
void hal_read_motors(float angle[SUREFOOT_MOTORS], float speed[SUREFOOT_MOTORS], float torque[SUREFOOT_MOTORS]);
/* Drive the motors with these commands until the next call. */
void hal_drive_motors(const motor_command command[SUREFOOT_MOTORS]);
/* Switch the motor drivers on. They stay on, since damped motors are also driven. */
void hal_enable_motors(void);
/* Temperature of each motor [degC]. */
void hal_read_temperatures(float temperature[SUREFOOT_MOTORS]);

/* Roll, pitch and yaw [rad] of the base in the world, and its angular velocity in the base frame [rad/s]. */
void hal_read_imu(float roll_pitch_yaw[3], float angular_velocity[3]);
/* Battery voltage [V]. */
float hal_read_voltage(void);

/* Further hazard that damps the motors, such as a drive that does not answer: a surefoot_reason and a text, or 0. */
uint8_t hal_hazard(const char **text);
/* Reason to ask the host to bring the robot to rest, such as a remote control: a surefoot_reason and a text, or 0. */
uint8_t hal_sit(const char **text);

/* Start a watchdog that resets the microcontroller if it is not fed within this time. */
void hal_start_watchdog(uint32_t microseconds);
void hal_feed_watchdog(void);

#endif
