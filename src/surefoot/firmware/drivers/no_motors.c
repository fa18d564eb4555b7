/* Starting point without motors. The link works and `surefoot doctor` finds the robot, but it cannot be armed.
 *
 * Replace the functions one by one, in the order of README.md: readings first, hal_drive_motors last. */
#include <math.h>

#include "drivers.h"
#include "hal.h"

void start_motors(void)
{
}

void hal_read_motors(float angle[SUREFOOT_MOTORS], float speed[SUREFOOT_MOTORS], float torque[SUREFOOT_MOTORS])
{
    int m;

    for (m = 0; m < SUREFOOT_MOTORS; m++) {
        angle[m] = NAN;   /* rad, in the order and with the signs of core/robot.h */
        speed[m] = NAN;   /* rad/s */
        torque[m] = 0.0f; /* N m, from the current */
    }
}

void hal_drive_motors(const motor_command command[SUREFOOT_MOTORS])
{
    (void)command; /* a plain drive uses `effort`, a drive with its own PD control the other values */
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

uint8_t hal_hazard(const char **text)
{
    (void)text;
    return SUREFOOT_REASON_NONE;
}
