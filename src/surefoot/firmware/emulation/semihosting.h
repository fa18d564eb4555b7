/* Standard input and output of QEMU for a program that runs in it, by Arm semihosting. */
#ifndef SEMIHOSTING_H
#define SEMIHOSTING_H

#include <stdbool.h>
#include <stddef.h>

void open_host(void);
/* Wait for `size` bytes; return whether they have arrived. */
bool read_host(void *bytes, size_t size);
/* Write bytes; end QEMU if they are not read. */
void write_host(const void *bytes, size_t size);
void end_host(void);

#endif
