/* Motors and sensors of a simulated body, for board.elf in QEMU; clock, interrupts and serial line are real.
 *
 * In each servo step the program writes the efforts of the motors (f32 each) to QEMU's standard output. Then it waits
 * on standard input for the readings one step later: angles, speeds, torques and temperatures of the motors; roll,
 * pitch, yaw, three angular rates and the voltage; all f32. */
#include <stddef.h>

#include "drivers.h"
#include "hal.h"
#include "readings.h"
#include "semihosting.h"

#define SENT offsetof(readings, hazard) /* bytes of the readings that are sent */

void start_motors(void)
{
    open_host();
    (void)read_host(&seen, SENT);
}

void start_sensors(void)
{
}

void hal_enable_motors(void)
{
}

void hal_drive_motors(const motor_command command[SUREFOOT_MOTORS])
{
    float effort[SUREFOOT_MOTORS];
    int m;

    for (m = 0; m < SUREFOOT_MOTORS; m++) {
        effort[m] = command[m].effort;
    }
    write_host(effort, sizeof(effort));
    if (!read_host(&seen, SENT)) {
        end_host();
    }
}
