/* Interface to surefoot's emulator; see events.c. */
#ifndef EVENTS_H
#define EVENTS_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

/* Wait for `size` bytes from the emulator; return whether they have arrived. */
bool read_event(void *bytes, size_t size);
void write_answer(const void *bytes, size_t size);
/* Processor cycles, modulo 2^24; 0 if they are not counted. */
uint32_t read_cycles(void);

/* Run the board's program until the events end. */
void run_events(void);

#endif
