/* Program of the board: the robot's side of docs/wire-protocol.md, with the same rules as deploy/board/firmware.py.
 *
 * It allocates no memory and never waits. Its constants are in robot.h, which is generated for one robot; hal.h
 * abstracts the hardware. Times are whole microseconds of hal_time. */
#ifndef BOARD_H
#define BOARD_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "surefoot_wire.h"

#define BOARD_NEVER UINT64_MAX

/* Status of the program, for emulators and tests. */
typedef struct {
    const char *robot;                          /* 24 bytes */
    uint8_t mode;                               /* a surefoot_mode */
    uint8_t reason;                             /* a surefoot_reason */
    uint16_t owner;                             /* the operator's session; 0: none */
    float motor_values[SUREFOOT_MOTORS];        /* angles or duties that the motors of an armed robot follow */
    uint64_t command_time;                      /* time of the last accepted command, or of arming */
    uint64_t next_state;                        /* time at which the next state is due */
    uint64_t reserved_until;                       /* time after which another operator may connect */
    uint32_t frames, damaged, foreign, unknown; /* received frames, by result of decoding */
    uint32_t old_numbers, stale;                /* frames and commands that were dropped */
} board_status;

/* Start the program. */
void board_start(void);
/* Process bytes received from the host. */
void board_receive(const uint8_t *bytes, size_t size);
/* Run a servo step: check the sensors, drive the motors. */
void board_tick(void);
/* Send a state if one is due. */
void board_report(void);
board_status board_show(void);
/* Start the program and run it forever. */
void board_run(void);

#endif
