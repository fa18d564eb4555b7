/* What the board's program needs to be run by surefoot's emulator: see events.c. */
#ifndef EVENTS_H
#define EVENTS_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

/* Wait for so many bytes of the emulator; return whether they have come. */
bool read_event(void *bytes, size_t size);
void write_answer(const void *bytes, size_t size);
/* Cycles of the processor, modulo 2^24; 0 where nobody counts them. */
uint32_t read_cycles(void);

/* Run the board's program until no event comes any more. */
void run_events(void);

#endif
