/* No motors and no sensors: where to begin. The link works, `surefoot doctor` sees the robot, and it does not arm.
 *
 * Replace the functions one by one, in the order of README.md: readings first, hal_drive_motors last. */
#include <math.h>

#include "hal.h"
#include "motors.h"

void start_motors(void)
{
}

void hal_read_motors(float angle[SUREFOOT_MOTORS], float speed[SUREFOOT_MOTORS], float torque[SUREFOOT_MOTORS])
{
    int m;

    for (m = 0; m < SUREFOOT_MOTORS; m++) {
        angle[m] = NAN; /* rad, in the order and with the signs of core/robot.h */
        speed[m] = NAN; /* rad/s */
        torque[m] = 0.0f; /* N m, of the current */
    }
}

void hal_drive_motors(const float effort[SUREFOOT_MOTORS])
{
    (void)effort; /* duty of a DC motor, -1 to 1; torque [N m] of a joint actuator */
}

void hal_enable_motors(void)
{
}

void hal_read_temperatures(float temperature[SUREFOOT_MOTORS])
{
    int m;

    for (m = 0; m < SUREFOOT_MOTORS; m++) {
        temperature[m] = NAN; /* degC */
    }
}

void hal_read_imu(float roll_pitch_yaw[3], float angular_velocity[3])
{
    int k;

    for (k = 0; k < 3; k++) {
        roll_pitch_yaw[k] = angular_velocity[k] = NAN; /* rad, and rad/s in the base frame: x forward, y left, z up */
    }
}

float hal_read_voltage(void)
{
    return NAN; /* V */
}

uint8_t hal_hazard(const char **text)
{
    (void)text;
    return SUREFOOT_REASON_NONE;
}

uint8_t hal_sit(const char **text)
{
    (void)text;
    return SUREFOOT_REASON_NONE;
}
