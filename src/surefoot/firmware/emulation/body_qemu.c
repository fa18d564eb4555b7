/* Motors and sensors of a simulated body, for board.elf in QEMU: clock, interrupts and serial line are the board's own.
 *
 * In each servo step the program writes the efforts of the motors (f32 each) to QEMU's standard output, and waits on its
 * standard input for what the body reads a step later: angles, speeds, torques and temperatures of the motors; roll,
 * pitch, yaw, three rates and the voltage; all f32. */
#include <string.h>

#include "drivers.h"
#include "hal.h"
#include "semihosting.h"

static struct {
    float angle[SUREFOOT_MOTORS], speed[SUREFOOT_MOTORS], torque[SUREFOOT_MOTORS], temperature[SUREFOOT_MOTORS];
    float roll_pitch_yaw[3], angular_velocity[3], voltage;
} seen;

void start_motors(void)
{
    open_host();
    (void)read_host(&seen, sizeof(seen));
}

void start_sensors(void)
{
}

void hal_enable_motors(void)
{
}

void hal_read_motors(float angle[SUREFOOT_MOTORS], float speed[SUREFOOT_MOTORS], float torque[SUREFOOT_MOTORS])
{
    memcpy(angle, seen.angle, sizeof(seen.angle));
    memcpy(speed, seen.speed, sizeof(seen.speed));
    memcpy(torque, seen.torque, sizeof(seen.torque));
}

void hal_drive_motors(const motor_order order[SUREFOOT_MOTORS])
{
    float effort[SUREFOOT_MOTORS];
    int m;

    for (m = 0; m < SUREFOOT_MOTORS; m++) {
        effort[m] = order[m].effort;
    }
    write_host(effort, sizeof(effort));
    if (!read_host(&seen, sizeof(seen))) {
        end_host();
    }
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
    (void)text;
    return SUREFOOT_REASON_NONE;
}

uint8_t hal_sit(const char **text)
{
    (void)text;
    return SUREFOOT_REASON_NONE;
}
