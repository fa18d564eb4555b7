/* Standard input and output of QEMU, for a program in it: Arm's semihosting. */
#ifndef SEMIHOSTING_H
#define SEMIHOSTING_H

#include <stdbool.h>
#include <stddef.h>

void open_host(void);
/* Wait for so many bytes; return whether they have come. */
bool read_host(void *bytes, size_t size);
/* Write bytes; end QEMU, if nobody reads them. */
void write_host(const void *bytes, size_t size);
void end_host(void);

#endif
