/* Hardware abstraction of the board's program for surefoot's emulator, which drives it by events.
 *
 * Events are read by read_event, and each is answered by write_answer before the next one. Numbers are little-endian
 * and packed. An event is
 *
 *     u8   type: 'T' servo step, 'R' a state may be due, 'B' bytes have arrived on the serial line
 *     u64  time [us]
 *     u16  size of the content: readings for T and R, bytes of the line for B
 *     content
 *
 * and the answer is a struct `answer`, followed by the bytes to send on the line. Before the first event the program
 * writes its schema (u32) and the name of its robot (24 bytes). Time advances only with events. */
#include "events.h"

#include <string.h>

#include "board.h"
#include "hal.h"
#include "readings.h"

#pragma pack(push, 1)
typedef struct {
    uint8_t what;
    uint64_t time;
    uint16_t size;
} event;

typedef struct {
    uint8_t mode, reason;
    uint16_t owner;
    uint64_t command_time, next_state, reserved_until;
    uint32_t frames, damaged, foreign, unknown, old_numbers, stale;
    float effort[SUREFOOT_MOTORS], motor_values[SUREFOOT_MOTORS];
    uint8_t enabled;
    uint32_t watchdog; /* us; 0: none */
    uint32_t cycles; /* of the event */
    uint32_t size;
} answer;
#pragma pack(pop)

static uint64_t now;
static float driven[SUREFOOT_MOTORS];
static uint8_t enabled;
static uint32_t watchdog;
static uint8_t out[1u << 15];
static size_t out_size;

void hal_start(void)
{
}

uint64_t hal_time(void)
{
    return now;
}

void hal_idle(void)
{
}

size_t hal_read_line(uint8_t *bytes, size_t room)
{
    (void)bytes;
    (void)room;
    return 0; /* they arrive by events */
}

bool hal_write_line(const uint8_t *bytes, size_t size)
{
    if (size > sizeof(out) - out_size) {
        return false;
    }
    memcpy(out + out_size, bytes, size);
    out_size += size;
    return true;
}

void hal_drive_motors(const motor_command command[SUREFOOT_MOTORS])
{
    size_t m;

    for (m = 0; m < SUREFOOT_MOTORS; m++) {
        driven[m] = command[m].effort;
    }
}

void hal_enable_motors(void)
{
    enabled = 1;
}

void hal_start_watchdog(uint32_t microseconds)
{
    watchdog = microseconds; /* the emulator implements it */
}

void hal_feed_watchdog(void)
{
}

static void reply(uint32_t cycles)
{
    const board_status status = board_show();
    answer made = {
        .mode = status.mode,
        .reason = status.reason,
        .owner = status.owner,
        .command_time = status.command_time,
        .next_state = status.next_state,
        .reserved_until = status.reserved_until,
        .frames = status.frames,
        .damaged = status.damaged,
        .foreign = status.foreign,
        .unknown = status.unknown,
        .old_numbers = status.old_numbers,
        .stale = status.stale,
        .enabled = enabled,
        .watchdog = watchdog,
        .cycles = cycles & 0xFFFFFFu,
        .size = (uint32_t)out_size,
    };

    memcpy(made.effort, driven, sizeof(driven));
    memcpy(made.motor_values, status.motor_values, sizeof(status.motor_values));
    write_answer(&made, sizeof(made));
    write_answer(out, out_size);
    out_size = 0;
}

static void take_readings(const uint8_t *content)
{
    memcpy(&seen, content, sizeof(seen));
    seen.hazard_text[TEXT] = seen.sit_text[TEXT] = '\0';
}

void run_events(void)
{
    static readings of_servo;
    static uint8_t content[UINT16_MAX];
    const uint32_t schema = SUREFOOT_SCHEMA;
    event next;

    board_start();
    write_answer(&schema, sizeof(schema));
    write_answer(board_show().robot, 24);
    while (read_event(&next, sizeof(next)) && read_event(content, next.size)) {
        const uint32_t before = read_cycles();

        now = next.time;
        if (next.what == 'B') {
            board_receive(content, next.size);
        } else if (next.size == sizeof(seen)) {
            take_readings(content);
            if (next.what == 'T') {
                of_servo = seen;
                board_tick();
            } else {
                board_report();
                seen = of_servo; /* readings of a state are delayed and noisy */
            }
        } else {
            return; /* not the emulator, or the emulator of another robot */
        }
        reply(read_cycles() - before);
    }
}
