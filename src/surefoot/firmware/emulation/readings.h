/* Sensor readings sent by the program that runs the board's program. */
#ifndef READINGS_H
#define READINGS_H

#include <stdint.h>

#include "robot.h"

#define TEXT 80u

#pragma pack(push, 1)
typedef struct {
    float angle[SUREFOOT_MOTORS], speed[SUREFOOT_MOTORS], torque[SUREFOOT_MOTORS], temperature[SUREFOOT_MOTORS];
    float roll_pitch_yaw[3], angular_velocity[3], voltage;
    uint8_t hazard, sit;
    char hazard_text[TEXT + 1u], sit_text[TEXT + 1u];
} readings;
#pragma pack(pop)

extern readings seen;

#endif
