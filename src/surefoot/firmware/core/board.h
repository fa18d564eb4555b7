/* The board's program: the robot's side of docs/wire-protocol.md, with the laws of deploy/board/firmware.py.
 *
 * It allocates nothing and waits for nothing. Its numbers are those of robot.h, which is made for one robot; its
 * surroundings are behind hal.h. Times are whole microseconds of hal_time. */
#ifndef BOARD_H
#define BOARD_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "surefoot_wire.h"

#define BOARD_NEVER UINT64_MAX

/* What the program shows of itself. */
typedef struct {
    const char *robot;                          /* 24 bytes */
    uint8_t mode;                               /* a surefoot_mode */
    uint8_t reason;                             /* a surefoot_reason */
    uint16_t owner;                             /* the operator's session; 0: none */
    float motor_values[SUREFOOT_MOTORS];        /* angles or duties that an armed robot's motors follow */
    uint64_t command_time;                      /* when a command was accepted last, or the robot armed */
    uint64_t next_state;                        /* when a state is due */
    uint64_t taken_until;                       /* after that another operator may connect */
    uint32_t frames, damaged, foreign, unknown; /* pieces that the line has brought */
    uint32_t old_numbers, stale;                /* frames and commands that were dropped */
} board_status;

/* Power on. */
void board_start(void);
/* Take bytes of the line to the host. */
void board_receive(const uint8_t *bytes, size_t size);
/* One servo step: check the sensors, drive the motors. */
void board_tick(void);
/* Send a state if one is due. */
void board_report(void);
board_status board_show(void);
/* Power on, then all of this for ever. */
void board_run(void);

#endif
