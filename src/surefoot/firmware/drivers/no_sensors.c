/* Starting point without IMU and battery. NaN readings prevent the robot from arming. */
#include <math.h>

#include "drivers.h"
#include "hal.h"

void start_sensors(void)
{
}

void hal_read_imu(float roll_pitch_yaw[3], float angular_velocity[3])
{
    int k;

    for (k = 0; k < 3; k++) {
        roll_pitch_yaw[k] = NAN;   /* rad: yaw about z, then pitch about y, then roll about x */
        angular_velocity[k] = NAN; /* rad/s in the base frame: x forward, y left, z up */
    }
}

float hal_read_voltage(void)
{
    return NAN; /* V */
}

uint8_t hal_sit(const char **text)
{
    (void)text; /* such as a button or a remote control */
    return SUREFOOT_REASON_NONE;
}
