#include "readings.h"

#include <string.h>

#include "hal.h"

readings seen;

void hal_read_motors(float angle[SUREFOOT_MOTORS], float speed[SUREFOOT_MOTORS], float torque[SUREFOOT_MOTORS])
{
    memcpy(angle, seen.angle, sizeof(seen.angle));
    memcpy(speed, seen.speed, sizeof(seen.speed));
    memcpy(torque, seen.torque, sizeof(seen.torque));
}

void hal_read_temperatures(float temperature[SUREFOOT_MOTORS])
{
    memcpy(temperature, seen.temperature, sizeof(seen.temperature));
}

void hal_read_imu(float roll_pitch_yaw[3], float angular_velocity[3])
{
    memcpy(roll_pitch_yaw, seen.roll_pitch_yaw, sizeof(seen.roll_pitch_yaw));
    memcpy(angular_velocity, seen.angular_velocity, sizeof(seen.angular_velocity));
}

float hal_read_voltage(void)
{
    return seen.voltage;
}

uint8_t hal_hazard(const char **text)
{
    *text = seen.hazard_text;
    return seen.hazard;
}

uint8_t hal_sit(const char **text)
{
    *text = seen.sit_text;
    return seen.sit;
}
